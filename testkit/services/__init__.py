# SPDX-License-Identifier: Apache-2.0
"""Programs of Debian that bench/services.py kills."""
