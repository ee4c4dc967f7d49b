# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# What every setup script shares: where things are, and how a long step is
# shown.  Sourced, never run.

set -euo pipefail

ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
BUILD=$ROOT/build
LOGS=$BUILD/logs
# What was fetched or takes long to make: kept for the next checkout, too.
CACHE=${XDG_CACHE_HOME:-${HOME:-/root}/.cache}/avckpt
mkdir -p "$LOGS"

if [ -t 1 ] && [ -z "${NO_COLOR:-}" ]; then
	BOLD=$'\e[1m' DIM=$'\e[2m' RED=$'\e[31m' GREEN=$'\e[32m' YELLOW=$'\e[33m' PLAIN=$'\e[0m'
else
	BOLD='' DIM='' RED='' GREEN='' YELLOW='' PLAIN=''
fi

say() { printf '%s\n' "$*"; }
note() { printf '    %s%s%s\n' "$DIM" "$*" "$PLAIN"; }
warn() { printf '%swarning:%s %s\n' "$YELLOW" "$PLAIN" "$*" >&2; }
die() {
	printf '%serror:%s %s\n' "$RED" "$PLAIN" "$*" >&2
	exit 1
}

# step NAME TITLE COMMAND...: runs the command with its output in
# build/logs/NAME.log, says what it does now and how long it took, and shows the
# end of the log when it fails.  Returns the command's status.
#
# A shell function given as COMMAND must end its lines with `|| return`: `set -e`
# means nothing to it where the caller says `step ... || die`.
step() {
	local title=$2 log=$LOGS/$1.log started=$SECONDS pid status=0 tick=0
	shift 2
	printf '%s==>%s %s\n' "$BOLD" "$PLAIN" "$title"
	# In a process group of its own, so that Ctrl-C can end all of it: a step must
	# not go on behind the prompt's back.
	set -m
	"$@" >"$log" 2>&1 </dev/null &
	pid=$!
	set +m
	trap 'kill -- "-$pid" 2>/dev/null; wait "$pid" 2>/dev/null; trap - INT TERM; exit 130' INT TERM
	while kill -0 "$pid" 2>/dev/null; do
		sleep 0.2
		tick=$((tick + 1))
		if [ -t 1 ]; then
			if [ $((tick % 5)) = 0 ]; then
				printf '\r\e[K    %s%ss  %s%s' "$DIM" $((SECONDS - started)) "$(last_line "$log" 60)" "$PLAIN"
			fi
		elif [ $((tick % 100)) = 0 ]; then
			note "$((SECONDS - started)) s: $(last_line "$log" 70)"
		fi
	done
	wait "$pid" || status=$?
	trap - INT TERM
	if [ -t 1 ]; then printf '\r\e[K'; fi
	if [ "$status" = 0 ]; then
		printf '    %sdone%s in %s s\n' "$GREEN" "$PLAIN" $((SECONDS - started))
	else
		printf '    %sfailed%s (status %s) after %s s; the end of %s:\n' \
			"$RED" "$PLAIN" "$status" $((SECONDS - started)) "${log#"$ROOT"/}" >&2
		tail -n 25 "$log" | sed 's/^/    | /' >&2
	fi
	return "$status"
}

last_line() { tail -c 400 "$1" | tr '\r' '\n' | sed '/^[[:space:]]*$/d' | tail -n 1 | tr -cd '[:print:]' | cut -c "1-$2"; }

have() { command -v "$1" >/dev/null 2>&1; }

# Only what git would track: build products must not change the key.  A tarball,
# or a checkout that git refuses to look at because somebody else owns it, has
# no git to ask.
list_sources() {
	git ls-files -z --cached --others --exclude-standard -- "$@" 2>/dev/null ||
		find "$@" \( -name build -o -name build-san -o -name build-fuzz -o -name __pycache__ -o -name '*.egg-info' \) -prune \
			-o \( -type f -o -type l \) ! -name '*.so' ! -name '_native.c' -print0 2>/dev/null || true
}

# One short key for the content of files (and any words given after `--`).
content_key() {
	local files=()
	while [ $# -gt 0 ] && [ "$1" != -- ]; do
		files+=("$1")
		shift
	done
	[ $# = 0 ] || shift
	{
		printf '%s\n' "$@"
		[ ${#files[@]} = 0 ] || (cd "$ROOT" && list_sources "${files[@]}" | sort -zu | while IFS= read -r -d '' file; do
			# A file that is deleted but still in the index has no content.
			if [ -f "$file" ]; then sha256sum -- "$file"; fi
		done)
	} | sha256sum | cut -c 1-16
}

# cached NAME KEY: sets `tarball` to where a thing of that name is kept that was made from what the
# key stands for, and removes what an interrupted run has left of another.
cached() {
	mkdir -p "$CACHE"
	rm -f "$CACHE/$1"-*.tar.new.*
	tarball=$CACHE/$1-$2.tar
}

# drop_older NAME: the same thing made from something else.
drop_older() { find "$CACHE" -name "$1-*.tar" ! -name "$(basename "$tarball")" -delete; }

# remove_other_tags KEY REPOSITORY...: removes images of earlier keys; those that
# a container still uses stay.
remove_other_tags() {
	local key=$1 repository image
	shift
	for repository in "$@"; do
		podman images --format '{{.Repository}}:{{.Tag}}' --filter "reference=$repository" |
			while read -r image; do
				case $image in
				*:"$key" | *:latest) ;;
				*) podman rmi "$image" >/dev/null 2>&1 || true ;;
				esac
			done
	done
}

# Sets MAX_FILES and MAX_PROCS: the resource limits a container may have here.
allowed_limits() {
	local pids
	MAX_FILES=$(ulimit -Hn)
	MAX_PROCS=$(ulimit -Hu)
	pids=$(cat /proc/sys/kernel/pid_max)
	[ "$MAX_FILES" != unlimited ] || MAX_FILES=1048576
	# Podman lowers its own limit to pid_max before the container starts.
	if [ "$MAX_PROCS" = unlimited ] || [ "$MAX_PROCS" -gt "$pids" ]; then MAX_PROCS=$pids; fi
}
