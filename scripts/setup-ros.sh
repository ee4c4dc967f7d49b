#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# What `make bench-ros` needs besides `make setup`: the image localhost/avckpt-ros
# (ROS 1 and PCL from Debian's own packages, with the nodes of examples/ros), the
# recorded drive, and matplotlib.  Nothing of it is installed on the host: the
# nodes are compiled in a container.
#
# Everything is kept under a key of what it is made from; what is there already is
# not made again.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
SUITE=bookworm # the last Debian with ROS 1
MIRROR=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
NODES=$ROOT/examples/ros/src
BAGS=$CACHE/ros-drive

# rosmaster and rosout: the core; rosbag-storage: the player; rospy and its
# messages; roslaunch for the container with two nodes.
RUN_PACKAGES=libroscpp4d,libpcl-filters1.13,libpcl-registration1.13,librosbag-storage4d,python3-rosmaster,rosout,python3-roslaunch
RUN_PACKAGES+=,python3-rospy,python3-sensor-msgs,python3-geometry-msgs,python3-std-msgs,python3-diagnostic-msgs,python3-numpy,procps
BUILD_PACKAGES=g++,pkg-config,make,libroscpp-dev,libsensor-msgs-dev,libgeometry-msgs-dev,librosbag-storage-dev,pluginlib-dev
BUILD_PACKAGES+=,libpcl-filters1.13,libpcl-registration1.13,libeigen3-dev,libflann-dev,libboost-dev
# Headers only: libpcl-dev depends on VTK, OpenNI and 400 packages more.
HEADERS="libpcl-dev libpcl-conversions-dev libpcl-msgs-dev"

# bootstrap PACKAGES [HOOK]: a Debian with these packages, as $tarball.
bootstrap() {
	local slim=(path-exclude=/usr/share/doc/* path-exclude=/usr/share/man/* path-exclude=/usr/share/locale/*)
	local new=$tarball.new.$$ hook=()
	if [ $# -gt 1 ]; then hook=("--customize-hook=$2"); fi
	mmdebstrap --format=tar --variant=apt --include="$1" "${slim[@]/#/--dpkgopt=}" "${hook[@]}" \
		"$SUITE" "$new" "$MIRROR" || return
	mv "$new" "$tarball"
}

import() {
	podman import --change 'ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin' \
		--change 'CMD ["/bin/sh"]' "$tarball" "$1" || return
}

# image REPOSITORY KEY PACKAGES [HOOK]
image() {
	local name=${1#localhost/} key=$2 tarball
	if podman image exists "$1:$key" 2>/dev/null; then return 0; fi
	cached "$name" "$key"
	[ -f "$tarball" ] || step "$name" "fetching Debian's packages for $name" bootstrap "${@:3}" ||
		die "$name: $SUITE could not be fetched from $MIRROR (AVCKPT_MIRROR names another mirror)"
	step "$name-import" "importing it as $1" import "$1:$key" || die "podman could not import $name"
	remove_other_tags "$key" "$1"
	drop_older "$name"
}

compile() {
	podman run --rm --pull=never --network=none -v "$NODES:/src:ro" -v "$OUT:/out" \
		"localhost/avckpt-ros-build:$build_key" make -j2 -C /src OUT=/out || return
}

assemble() {
	podman build --network=none --pull=never --build-arg "BASE=localhost/avckpt-ros-run:$run_key" \
		--ulimit "nofile=$MAX_FILES:$MAX_FILES" --ulimit "nproc=$MAX_PROCS:$MAX_PROCS" \
		--build-context "nodes=$OUT" -f examples/ros/Containerfile -t "localhost/avckpt-ros:$key" examples/ros || return
}

record() {
	rm -rf "$BAGS.new"
	mkdir -p "$BAGS.new" || return
	podman run --rm --pull=never --network=none -v "$BAGS.new:/drive" "localhost/avckpt-ros:$key" \
		make_drive /drive/drive.bag /drive/map.f32 || return
	rm -rf "$BAGS"
	mv "$BAGS.new" "$BAGS" || return
	printf '%s\n' "$drive_key" >"$BAGS/.key"
}

have mmdebstrap || die "mmdebstrap is missing: make setup installs it"
allowed_limits

# shellcheck disable=SC2016 # $1, the new root, is mmdebstrap's to fill in
fetch_headers='cd "$1/tmp" && APT_CONFIG=$MMDEBSTRAP_APT_CONFIG apt-get download '$HEADERS' &&
	for deb in *.deb; do dpkg-deb -x "$deb" "$1" || exit 1; done && rm -f ./*.deb'
run_key=$(content_key -- "$SUITE" "$MIRROR" "$RUN_PACKAGES" "$(declare -f bootstrap import)")
build_key=$(content_key -- "$SUITE" "$MIRROR" "$BUILD_PACKAGES" "$fetch_headers" "$(declare -f bootstrap import)")
key=$(content_key examples/ros/src examples/ros/Containerfile examples/ros/nodes -- "$run_key" "$build_key")
drive_key=$(content_key examples/ros/src/make_drive.cpp examples/ros/src/city.h --)

image localhost/avckpt-ros-run "$run_key" "$RUN_PACKAGES"
if ! podman image exists "localhost/avckpt-ros:$key" 2>/dev/null; then
	image localhost/avckpt-ros-build "$build_key" "$BUILD_PACKAGES" "$fetch_headers"
	OUT=$BUILD/ros
	mkdir -p "$OUT"
	step ros-compile "compiling the ROS nodes" compile || die "the ROS nodes could not be compiled"
	step ros-image "building localhost/avckpt-ros" assemble || die "localhost/avckpt-ros could not be built"
	remove_other_tags "$key" localhost/avckpt-ros
fi
podman tag "localhost/avckpt-ros:$key" localhost/avckpt-ros:latest

if [ "$(cat "$BAGS/.key" 2>/dev/null)" != "$drive_key" ]; then
	step ros-drive "recording a drive through a synthetic city (0.5 GB)" record || die "the drive could not be recorded"
fi

if ! .venv/bin/python -c 'import matplotlib' 2>/dev/null; then
	step matplotlib "installing matplotlib into .venv" \
		.venv/bin/python -m pip install --disable-pip-version-check 'matplotlib>=3.7' ||
		die "matplotlib could not be installed into .venv"
fi
note "ROS: localhost/avckpt-ros and the drive in $BAGS are there"
