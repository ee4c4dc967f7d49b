# SPDX-License-Identifier: Apache-2.0
"""What happened: one record of it for log, API, history, notifications and metrics."""
