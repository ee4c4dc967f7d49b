# SPDX-License-Identifier: Apache-2.0
"""What an application died of, and where."""
