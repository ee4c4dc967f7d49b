# SPDX-License-Identifier: Apache-2.0
"""avckpt: containers that live through crashes."""

__version__ = "0.1.0"
