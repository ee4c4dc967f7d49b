#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Every style check; goes on after the first that fails, so that one run shows
# all there is to mend.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
status=0
check() {
	printf '%s==>%s %s\n' "$BOLD" "$PLAIN" "$1"
	shift
	"$@" || status=1
}

# Tables and code are as wide as they must be.
# shellcheck disable=SC2317  # called by check
narrow() {
	! LC_ALL=C.UTF-8 grep -nHP '^(?!\||    ).{101,}' "$@"
}

mapfile -t shell < <(git ls-files --cached --others --exclude-standard 'scripts/*.sh' 'packaging/deb*/postinst' 'packaging/deb*/prerm' .ci/run)
mapfile -t c < <(git ls-files --cached --others --exclude-standard '*.c' '*.h')

check "ruff check" .venv/bin/ruff check .
check "ruff format" .venv/bin/ruff format --check --diff .
mapfile -t typed < <(ls -d setup.py scripts examples sidecar hooks native tests testkit bench 2>/dev/null)
check "mypy --strict" .venv/bin/mypy "${typed[@]}"
mapfile -t python < <(git ls-files --cached --others --exclude-standard '*.py')
check "arguments of functions" scripts/arguments.py "${c[@]}" "${python[@]}"
mapfile -t documents < <(git ls-files --cached --others --exclude-standard '*.md' ':!bench/results')
check "lines of documents" narrow "${documents[@]}"
check "layers of the engine" make -s -C native layers
# What is not checked is not right: a missing tool is a failure.
check "shellcheck" shellcheck -x "${shell[@]}"
check "clang-format" clang-format --dry-run --Werror "${c[@]}"
exit "$status"
