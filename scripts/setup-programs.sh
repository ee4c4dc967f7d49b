#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The image localhost/avckpt-programs: the real programs that testkit/programs
# checkpoints, kills and restores.  It is tagged with a key of what it is made
# from: an unchanged tree builds nothing, and a changed source compiles only.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT/testkit/programs"
BASE=localhost/avckpt-base
IMAGE=localhost/avckpt-programs
BUILDER=localhost/avckpt-programs-build

base_id=$(podman image inspect --format '{{.Id}}' "$BASE:latest") || die "no base image: make setup builds it"
sources=(Containerfile server_cpp.cpp server_go.go ServerJvm.java)
key=$(content_key "${sources[@]/#/testkit/programs/}" -- "$base_id")
if podman image exists "$IMAGE:$key"; then
	podman tag "$IMAGE:$key" "$IMAGE:latest"
	note "image of real programs: $IMAGE is there"
	exit 0
fi

# The limits and tags: as in setup-sidecar.sh.
build() {
	local podman_build
	allowed_limits
	podman_build=(podman build --network=host --pull=never --layers --build-arg "BASE=$BASE"
		--ulimit "nofile=$MAX_FILES:$MAX_FILES" --ulimit "nproc=$MAX_PROCS:$MAX_PROCS" -f Containerfile)
	"${podman_build[@]}" --target build -t "$BUILDER:$key" . || return
	"${podman_build[@]}" -t "$IMAGE:$key" . || return
	podman tag "$IMAGE:$key" "$IMAGE:latest"
}
step programs "building the image of real programs (the first time it fetches nginx, Node.js, Go and a JDK)" build ||
	die "the image of real programs could not be built"
remove_other_tags "$key" "$IMAGE" "$BUILDER"
