# SPDX-License-Identifier: Apache-2.0
"""The page of `avckpt web`, and the server that hands it the sidecar's API."""
