# SPDX-License-Identifier: Apache-2.0
"""HTTP clients that keep their connections, and servers that are killed meanwhile: does every answer belong
to its request?

    python -m testkit.answers [--requests 20000] [--tcp keep] [nginx haproxy prefork]
"""
