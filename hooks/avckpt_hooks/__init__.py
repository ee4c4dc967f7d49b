# SPDX-License-Identifier: Apache-2.0
"""The programs that Podman and the OCI runtime call while a container starts and stops.

They run on the host and must not depend on the rest of avckpt: standard library only,
and each stage imports only what it uses.
"""

from __future__ import annotations

VERSION = "0.1.0"
"""The only definition: package, sidecar and native code take it from this line."""
