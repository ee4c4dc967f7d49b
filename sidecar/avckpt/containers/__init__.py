# SPDX-License-Identifier: Apache-2.0
"""The containers that the sidecar knows, and how it learns of them."""
