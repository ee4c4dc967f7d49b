# SPDX-License-Identifier: Apache-2.0
"""Events: one record for log, API, history, notifications and metrics."""
