# SPDX-License-Identifier: Apache-2.0
"""Real programs, their clients, and rounds of checkpoint, kill and restore on them; see README.md."""
