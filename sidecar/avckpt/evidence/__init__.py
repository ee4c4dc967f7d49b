# SPDX-License-Identifier: Apache-2.0
"""Crash reports: what an application died of, and where."""
