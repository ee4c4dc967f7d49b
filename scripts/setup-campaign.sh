#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Compilers of the programs with faults in them (bench/faults).  Without Go there is no campaign in it.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

missing=()
have g++ || missing+=(g++)
have go || missing+=(golang-go)
if [ ${#missing[@]} -gt 0 ] && have apt-get; then
	step campaign "installing ${missing[*]}" apt-get install -q -y --no-install-recommends "${missing[@]}" ||
		say "could not be installed: ${missing[*]}"
fi
have g++ || die "needed: g++"
