#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# build/avckpt_VERSION_ARCH.deb: an environment of its own below /usr/lib/avckpt, with the
# Python packages that Debian has too old or not at all, for the Python of this Debian.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
umask 022
have dpkg-deb || die "dpkg-deb is missing: a .deb is made on Debian or Ubuntu"
python=$(/usr/bin/python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])') || die "the system's Python is missing"
version=$(.venv/bin/python -c 'from avckpt_hooks import VERSION; print(VERSION)')
arch=$(dpkg --print-architecture)
libc=$(ldd --version | sed -n '1s/.* //p')
stage=$BUILD/deb
deb=$BUILD/avckpt_${version}_$arch.deb
home=$stage/usr/lib/avckpt
site=$home/lib/python$python/site-packages

wheel() {
	rm -rf "$BUILD/wheel"
	.venv/bin/python -m pip wheel --disable-pip-version-check -q --no-deps --no-build-isolation -w "$BUILD/wheel" .
}

fill() {
	local machine
	machine=$(uname -m)
	.venv/bin/python -m pip install --disable-pip-version-check -q --target "$site" --only-binary=:all: \
		--implementation cp --python-version "$python" --abi "cp${python/./}" --abi abi3 --abi none \
		--platform "manylinux_2_28_$machine" --platform "manylinux_2_17_$machine" --platform "manylinux2014_$machine" \
		--platform "linux_$machine" "$BUILD"/wheel/avckpt-*.whl || return
	rm -rf "${site:?}/bin" "${site:?}/share" || return
	find "$site" -name __pycache__ -prune -exec rm -rf {} + || return
	# Where pip found the wheel is nobody's business.
	rm -f "$site"/avckpt-*.dist-info/direct_url.json || return
	sed -i '/direct_url\.json/d' "$site"/avckpt-*.dist-info/RECORD || return
	/usr/bin/python3 -m compileall -q --invalidation-mode unchecked-hash -s "$stage" "$site"
}

pack() {
	mkdir -p "$home/bin" "$stage/usr/bin" "$stage/lib/systemd/system" "$stage/DEBIAN" || return
	ln -s /usr/bin/python3 "$home/bin/python" || return
	printf 'home = /usr/bin\ninclude-system-site-packages = false\nversion = %s\n' "$python" >"$home/pyvenv.cfg" || return
	printf '#!/usr/lib/avckpt/bin/python -I\nfrom avckpt.cli.commands import main\nmain()\n' >"$stage/usr/bin/avckpt" || return
	chmod 0755 "$stage/usr/bin/avckpt" || return
	install -D -m 0644 packaging/avckpt-sidecar.service -t "$stage/lib/systemd/system" || return
	install -D -m 0644 docs/avckpt.1 -t "$stage/usr/share/man/man1" || return
	gzip -9n "$stage/usr/share/man/man1/avckpt.1" || return
	install -D -m 0644 LICENSE "$stage/usr/share/doc/avckpt/copyright" || return
	complete bash "$stage/usr/share/bash-completion/completions/avckpt" || return
	complete zsh "$stage/usr/share/zsh/vendor-completions/_avckpt" || return
	complete fish "$stage/usr/share/fish/vendor_completions.d/avckpt.fish" || return
	sed -e "s/@VERSION@/$version/; s/@ARCH@/$arch/; s/@PYTHON@/$python/; s/@LIBC@/$libc/" \
		-e "s/@PYTHON_NEXT@/${python%.*}.$((${python#*.} + 1))/" -e "s/@SIZE@/$(du -sk "$stage" | cut -f 1)/" \
		packaging/deb/control >"$stage/DEBIAN/control" || return
	install -m 0755 packaging/deb/postinst packaging/deb/prerm "$stage/DEBIAN" || return
	dpkg-deb --root-owner-group -Zgzip -b "$stage" "$deb"
}

complete() { # SHELL FILE
	mkdir -p "$(dirname "$2")" && .venv/bin/avckpt completion "$1" >"$2"
}

rm -rf "$stage"
step deb-wheel "building the wheel" wheel || die "the wheel could not be built"
step deb-fill "fetching the Python packages it needs" fill || die "the Python packages could not be fetched"
step deb-pack "packing" pack || die "the package could not be made"
note "$deb ($(du -h "$deb" | cut -f 1)): apt install $deb"
