#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The sidecar image localhost/avckpt-sidecar, from Containerfile.  It is tagged
# with a key of the sources: an unchanged tree builds nothing.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
BASE=localhost/avckpt-base
IMAGE=localhost/avckpt-sidecar
BUILDER=localhost/avckpt-sidecar-build
WHEELS=$BUILD/wheels

base_id=$(podman image inspect --format '{{.Id}}' "$BASE:latest") || die "no base image: make setup builds it"
key=$(content_key Containerfile .containerignore pyproject.toml setup.py LICENSE native sidecar hooks oci-hooks.d packaging -- "$base_id")
if podman image exists "$IMAGE:$key"; then
	podman tag "$IMAGE:$key" "$IMAGE:latest"
	note "sidecar image: $IMAGE is there"
	exit 0
fi

# Python packages are fetched on the host, which knows how to reach them (an
# index, a proxy and certificates of its own), for the Python in the base image.
fetch_wheels() {
	local version arch pip=(.venv/bin/python -m pip --disable-pip-version-check)
	version=$(podman run --rm --pull=never --network=none "$BASE" \
		python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])') || return
	arch=$(uname -m)
	rm -rf "$WHEELS"
	mkdir -p "$WHEELS" || return
	# typing_extensions by name: pip looks at the markers of its own Python here, and
	# one newer than the base image's would leave it out.
	# shellcheck disable=SC2046 # one word per requirement is meant
	"${pip[@]}" download -d "$WHEELS" --only-binary=:all: --implementation cp --python-version "$version" \
		--abi "cp${version/./}" --abi abi3 --abi none \
		--platform "manylinux_2_28_$arch" --platform "manylinux_2_17_$arch" --platform "manylinux2014_$arch" \
		'setuptools>=77' typing_extensions $(sed -n '/^dependencies/,/^]/s/^[[:space:]]*"\(.*\)",$/\1/p' pyproject.toml)
}

wheels_key=$(content_key pyproject.toml scripts/setup-sidecar.sh -- "$base_id")
if [ "$(cat "$WHEELS/.key" 2>/dev/null)" != "$wheels_key" ]; then
	step wheels "fetching the sidecar's Python packages" fetch_wheels || die "the sidecar's Python packages could not be fetched"
	printf '%s\n' "$wheels_key" >"$WHEELS/.key"
fi

# --network=host: no bridge network is needed to build.  The compiler's stage gets
# a tag of its own, so that an old one can be found and removed.  The limits: Podman 5
# sees to them when it runs a container, but not when it builds.
build() {
	local podman_build
	allowed_limits
	podman_build=(podman build --network=host --pull=never --layers --build-arg "BASE=$BASE"
		--ulimit "nofile=$MAX_FILES:$MAX_FILES" --ulimit "nproc=$MAX_PROCS:$MAX_PROCS"
		-v "$WHEELS:/wheels:ro" -f Containerfile)
	"${podman_build[@]}" --target build -t "$BUILDER:$key" . || return
	"${podman_build[@]}" -t "$IMAGE:$key" . || return
	podman tag "$IMAGE:$key" "$IMAGE:latest"
}
step sidecar "building the sidecar image (podman build; the first time it fetches a compiler)" build ||
	die "the sidecar image could not be built"
remove_other_tags "$key" "$IMAGE" "$BUILDER"
