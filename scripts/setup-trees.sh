#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The image localhost/avckpt-trees: programs of many processes from Debian's own
# packages, for the tests of process trees (`make test-trees`).

# shellcheck source=scripts/lib-debian.sh
. "$(dirname "$0")/lib-debian.sh"

# Read by debian_image.  No database yet: each test makes its own.
# shellcheck disable=SC2034
EXCLUDES=('/usr/lib/llvm*' '/usr/lib/postgresql/*/lib/bitcode/*')
# shellcheck disable=SC2016,SC2034 # $1 is mmdebstrap's to fill in
ESSENTIAL_HOOK='mkdir -p "$1/etc/postgresql-common" && echo create_main_cluster = false > "$1/etc/postgresql-common/createcluster.conf"'
# shellcheck disable=SC2034
REMOVED='var/lib/postgresql/*/main'

debian_image trees "image for the tests of process trees" nginx-light,gunicorn,python3,postgresql,procps
