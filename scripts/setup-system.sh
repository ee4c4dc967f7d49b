#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Finds out which system packages are missing and, on a system with apt,
# installs them.  Elsewhere says what is needed and why.
#
# Everything is found by looking for what is needed, not for the package's name:
# a Podman from anywhere is as good as Debian's.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

PATH=$PATH:/usr/sbin:/sbin
PYTHON=${PYTHON:-python3}

has_static_libc() { # avckpt-init is static: it must run in any container
	local out status=0
	out=$(mktemp)
	echo 'int main(void) { return 0; }' | cc -x c -static -o "$out" - 2>/dev/null || status=1
	rm -f "$out"
	return "$status"
}
has_cross_libc() {
	local out status=0
	out=$(mktemp)
	echo 'int main(void) { return 0; }' | aarch64-linux-gnu-gcc -x c -static -o "$out" - 2>/dev/null || status=1
	rm -f "$out"
	return "$status"
}
has_python() { have "$PYTHON" && "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 9))'; }
has_venv() { has_python && "$PYTHON" -c 'import venv, ensurepip' 2>/dev/null; }
has_python_headers() {
	has_python && [ -f "$("$PYTHON" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')/Python.h" ]
}
has_runtime() { have crun || have runc; }
has_bootstrap() { have mmdebstrap || have debootstrap; }
has_debian_keyring() { compgen -G '/usr/share/keyrings/debian-archive-keyring.*' >/dev/null; }
has_conmon() { have conmon || [ -x /usr/libexec/podman/conmon ] || [ -x /usr/lib/podman/conmon ]; }
in_podman_dirs() {
	local dir
	for dir in /usr/lib/podman /usr/libexec/podman /usr/local/lib/podman /usr/local/libexec/podman; do
		if [ -x "$dir/$1" ]; then return 0; fi
	done
	return 1
}
has_netavark() { in_podman_dirs netavark; }
has_cyclonedds() { echo "#include <dds/dds.h>" | cc -x c -fsyntax-only - 2>/dev/null; }
has_libfuzzer() {
	local out status=0
	out=$(mktemp)
	echo 'int LLVMFuzzerTestOneInput(const char *data, unsigned long size) { return !data && size; }' |
		clang -x c -fsanitize=fuzzer,address -o "$out" - 2>/dev/null || status=1
	rm -f "$out"
	return "$status"
}
has_catatonit() { have catatonit || in_podman_dirs catatonit; }

# The newest of what is needed of each: PTRACE_GET_RSEQ_CONFIGURATION; `podman generate
# spec`, by which the hooks learn a container's labels.
LINUX_LEAST=5.13
PODMAN_LEAST=4.3

at_least() { [ "$(printf '%s\n' "$2" "$1" | sort -V | head -n 1)" = "$2" ]; }
check_versions() {
	local linux podman
	linux=$(uname -r)
	at_least "$linux" "$LINUX_LEAST" || die "Linux $linux is too old: avckpt needs $LINUX_LEAST or newer"
	have podman || return 0
	podman=$(podman --version | cut -d' ' -f3)
	at_least "$podman" "$PODMAN_LEAST" ||
		die "Podman $podman is too old: avckpt needs $PODMAN_LEAST or newer, as in Debian 12 and Ubuntu 24.04"
}

# need | Debian's package | check | what for.  "optional" is installed where apt
# can, and its absence elsewhere is no more than a remark; "lint" is needed for
# `setup-system.sh lint` only.
NEEDS="
required|podman|have podman|runs the containers
required|conmon|has_conmon|watches a container's main process for Podman
required|crun|has_runtime|the OCI runtime (crun or runc)
required|gcc|have cc|compiles the engine and avckpt-init
required|libc6-dev|has_static_libc|C headers and the static C library: avckpt-init is a static program
required|binutils|have ld|links the code that is injected
required|python3|has_python|Python 3.9 or newer
required|python3-venv|has_venv|the virtual environment in .venv
required|python3-dev|has_python_headers|Python.h: the engine's Python binding is a C extension
required|mmdebstrap|has_bootstrap|makes the base image from Debian packages, without a registry
required|debian-archive-keyring|has_debian_keyring|the keys by which those packages are checked; Debian itself has them
required|iproute2|have ip|looks at the host's network
optional|netavark|has_netavark|bridge networks for containers
optional|iptables|have iptables|bridge networks for containers (Podman 4)
optional|nftables|have nft|bridge networks for containers (Podman 5)
lint|clang-format|have clang-format|checks the C code's style
lint|shellcheck|have shellcheck|checks the shell scripts
aarch64|gcc-aarch64-linux-gnu|has_cross_libc|compiles for aarch64
aarch64|libc6-dev-arm64-cross|has_cross_libc|headers and the static C library for aarch64
aarch64|g++-aarch64-linux-gnu|have aarch64-linux-gnu-g++|compiles the C++ program that the tests kill and restore
fuzz|clang|have clang|compiles fuzz targets
fuzz|libclang-rt-dev|has_libfuzzer|libFuzzer and the sanitizers
fuzz|llvm|have llvm-symbolizer|names the lines of what a sanitizer finds
view|chromium|have chromium|shows the page of avckpt web to a test
view|chromium-driver|have chromedriver|by which a test uses that browser
view|prometheus|have prometheus|reads the metrics in a test
view|zsh|have zsh|completes commands in a test
view|fish|have fish|completes commands in a test
optional|runc|have runc|the tests run on both OCI runtimes
optional|g++|have c++|compiles the C++ program that the tests kill and restore
optional|cyclonedds-dev|has_cyclonedds|a test of ROS 2's transport
optional|cyclonedds-tools|have idlc|a test of ROS 2's transport
optional|strace|have strace|kills a guard before its system calls, in a test
optional|stress-ng|have stress-ng|a test of processes of all kinds
optional|catatonit|has_catatonit|pods and 'podman run --init'
"

check_versions
missing_required=() missing_optional=()
while IFS='|' read -r need package check why; do
	[ -n "$need" ] || continue
	case $need in
	required | optional) ;;
	*) [ "$need" = "${1:-}" ] || continue ;;
	esac
	if ! $check; then
		if [ "$need" != optional ]; then missing_required+=("$package"); else missing_optional+=("$package"); fi
		note "missing: $package - $why"
	fi
done <<<"$NEEDS"

if [ $((${#missing_required[@]} + ${#missing_optional[@]})) = 0 ]; then
	note "system packages: everything is there"
	exit 0
fi

manual="${missing_required[*]:-}"
if ! have apt-get; then
	if [ -z "$manual" ]; then
		warn "no apt here; the optional packages above were not installed"
		exit 0
	fi
	die "no apt here: install what is missing with your own package manager (names as in Debian): $manual"
fi
if [ "$(id -u)" != 0 ]; then
	[ -n "$manual" ] || exit 0
	die "not root: run 'sudo apt-get install $manual', then make again"
fi

# A third-party source that is down must not keep us from Debian's own packages.
step apt-update "refreshing the package lists" apt-get update ||
	warn "some package lists could not be refreshed; going on with what there is"
# One that it does not know would keep apt-get from installing any of the others.
wanted=("${missing_required[@]}")
for package in "${missing_optional[@]}"; do
	if apt-cache show "$package" >/dev/null 2>&1; then
		wanted+=("$package")
	else
		warn "this system has no package $package; going on without"
	fi
done
[ ${#wanted[@]} != 0 ] || exit 0
step apt-install "installing ${wanted[*]}" \
	env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=180 install -y --no-install-recommends "${wanted[@]}" ||
	die "apt-get could not install: ${wanted[*]}"
check_versions
