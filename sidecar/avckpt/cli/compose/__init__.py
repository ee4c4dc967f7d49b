# SPDX-License-Identifier: Apache-2.0
"""Compose manifests: checked, and brought up and down with podman-compose."""
