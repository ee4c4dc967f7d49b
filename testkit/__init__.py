# SPDX-License-Identifier: Apache-2.0
"""What tests and benchmarks share: containers and sidecars, guards and fake inits, looks into /proc.

Run from the root of the checkout: `python -m pytest`, `python -m bench.run`.
"""
