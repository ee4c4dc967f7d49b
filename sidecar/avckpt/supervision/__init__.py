# SPDX-License-Identifier: Apache-2.0
"""What the daemon does for live containers besides checkpoints: health, memory, notifications."""
