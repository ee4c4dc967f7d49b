# SPDX-License-Identifier: Apache-2.0
"""What hooks and sidecar share: labels, protocol, messages to users.

Standard library only, as the hooks run on the host's own Python; nothing here imports
a hook or the sidecar.
"""
