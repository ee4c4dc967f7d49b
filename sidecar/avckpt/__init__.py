# SPDX-License-Identifier: Apache-2.0
"""avckpt: containers that live through crashes."""

from __future__ import annotations

from avckpt_hooks import VERSION as __version__

__all__ = ["__version__"]
