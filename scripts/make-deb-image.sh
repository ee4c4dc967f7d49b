#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# build/avckpt-sidecar-image_VERSION_ARCH.deb: the sidecar's image of this checkout, as
# `podman save` writes it.  A package of its own, because it is ten times the size of avckpt's,
# and a sidecar that is a service of the host needs none.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
umask 022
have dpkg-deb || die "dpkg-deb is missing: a .deb is made on Debian or Ubuntu"
IMAGE=localhost/avckpt-sidecar:latest
version=$(.venv/bin/python -c 'from avckpt_hooks import VERSION; print(VERSION)')
arch=$(dpkg --print-architecture)
stage=$BUILD/deb-image
deb=$BUILD/avckpt-sidecar-image_${version}_$arch.deb

pack() {
	mkdir -p "$stage/usr/share/avckpt" "$stage/DEBIAN" || return
	podman save -q -o "$stage/usr/share/avckpt/avckpt-sidecar.tar" "$IMAGE" || return
	install -D -m 0644 LICENSE "$stage/usr/share/doc/avckpt-sidecar-image/copyright" || return
	sed -e "s/@VERSION@/$version/; s/@ARCH@/$arch/; s/@SIZE@/$(du -sk "$stage" | cut -f 1)/" \
		packaging/deb-image/control >"$stage/DEBIAN/control" || return
	install -m 0755 packaging/deb-image/postinst packaging/deb-image/prerm "$stage/DEBIAN" || return
	dpkg-deb --root-owner-group -Zgzip -z6 -b "$stage" "$deb"
}

rm -rf "$stage"
step deb-image "packing the sidecar's image" pack || die "the package could not be made"
rm -rf "$stage"
note "$deb ($(du -h "$deb" | cut -f 1)): apt install $BUILD/avckpt_${version}_$arch.deb $deb"
