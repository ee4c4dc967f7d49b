# SPDX-License-Identifier: Apache-2.0
# The cffi extension; only native.py looks inside.
from typing import Any

ffi: Any
lib: Any
