# SPDX-License-Identifier: Apache-2.0
# The cffi extension; only engine.py looks inside.
from typing import Any

ffi: Any
lib: Any
