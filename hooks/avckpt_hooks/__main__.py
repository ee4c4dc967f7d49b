#!/usr/bin/python3 -IBS
# SPDX-License-Identifier: Apache-2.0
"""The program avckpt-hook: `avckpt-hook precreate|prestart|poststop`, see the module of that name.

Called avckpt-runtime, it is an OCI runtime.

-I and -S keep the user's and the site's Python out of it (and are faster), -B leaves no caches
behind that nothing would remove.
"""

from __future__ import annotations

import os
import sys

sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.realpath(__file__))))

called = os.path.basename(sys.argv[0])
stage = sys.argv[1] if len(sys.argv) > 1 else ""
if called == "avckpt-runtime":
    from avckpt_hooks.runtime import main
elif stage == "precreate":
    from avckpt_hooks.precreate import main
elif stage == "prestart":
    from avckpt_hooks.prestart import main
elif stage == "poststop":
    from avckpt_hooks.poststop import main
else:
    sys.exit("avckpt-hook: give one of precreate, prestart, poststop (Podman calls it, not you)")
sys.exit(main())
