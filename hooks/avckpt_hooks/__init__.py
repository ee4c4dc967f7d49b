# SPDX-License-Identifier: Apache-2.0
"""The programs that Podman and the OCI runtime call while a container starts and stops.

They run on the host, before anything else of avckpt need be there: standard
library only, and nothing imported that the stage at hand does not use.
"""

from __future__ import annotations

VERSION = "0.1.0"
"""Of everything: package, sidecar and native code take it from this line."""
