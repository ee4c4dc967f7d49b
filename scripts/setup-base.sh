#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The base image localhost/avckpt-base: a small Debian.  Demo, tests and the
# sidecar image start from it.

# shellcheck source=scripts/lib-debian.sh
. "$(dirname "$0")/lib-debian.sh"

# python3, redis-server: programs that are protected in tests; the rest is for
# looking around inside a container.
debian_image base "base image" python3,redis-server,procps,iproute2
