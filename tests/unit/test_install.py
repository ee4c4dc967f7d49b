# SPDX-License-Identifier: Apache-2.0
"""avckpt install and uninstall, on a root directory of its own."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import multiprocessing
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import avckpt
import avckpt_hooks
import pytest
from avckpt import artifacts
from avckpt.cli import install, sidecar_image
from avckpt.containers.process import start_time
from avckpt.errors import ConfigError
from avckpt_hooks.shared import protocol
from avckpt_hooks.shared.protocol import Register

from testkit.procfs import peak_kb

if os.geteuid() != 0:
    pytest.skip("avckpt install needs root", allow_module_level=True)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A host with a Python, systemd's folders and a Podman configuration."""
    return host(tmp_path)


def host(root: Path) -> Path:
    for folder in ("usr/bin", "usr/local/bin", "etc/containers/containers.conf.d", "etc/tmpfiles.d", "run"):
        (root / folder).mkdir(parents=True)
    (root / "usr/bin/python3").symlink_to("/usr/bin/python3")
    return root


def tree(root: Path) -> dict[str, tuple[int, bytes]]:
    """Everything under `root`: mode, and content or target."""

    def walk() -> Iterator[tuple[str, tuple[int, bytes]]]:
        for path in sorted(root.rglob("*")):
            mode = path.lstat().st_mode
            content = b""
            if stat.S_ISLNK(mode):
                content = os.readlink(path).encode()
            elif stat.S_ISREG(mode):
                content = path.read_bytes()
            yield str(path.relative_to(root)), (mode, content)

    return dict(walk())


def test_everything_is_in_its_place(root: Path) -> None:
    os.umask(0o077)
    try:
        done = install.install(root)
    finally:
        os.umask(0o022)
    assert not [line for line in done if line.startswith("warning")]
    libexec = root / "usr/local/libexec/avckpt"
    assert (libexec / "avckpt-init").read_bytes() == artifacts.init_binary().read_bytes()
    assert stat.S_IMODE((libexec / "avckpt-init").stat().st_mode) == 0o755
    # Users of containers come here too.
    for folder in (libexec, libexec / "avckpt_hooks", root / "usr/local/share/avckpt/oci-hooks.d", root / "run/avckpt"):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o755
    installed, source = libexec / "avckpt_hooks", artifacts.hooks_source()
    modules = {path.relative_to(installed) for path in installed.rglob("*.py")}
    assert modules == {path.relative_to(source) for path in source.rglob("*.py")}
    [hook_json] = (root / "usr/local/share/avckpt/oci-hooks.d").glob("*.json")
    assert json.loads(hook_json.read_text())["hook"]["path"] == "/usr/local/libexec/avckpt/avckpt-hook"
    done_by = subprocess.run([libexec / "avckpt-hook"], capture_output=True, text=True, check=False)
    assert "give one of precreate, prestart, poststop" in done_by.stderr
    conf = (root / "etc/containers/containers.conf.d/50-avckpt.conf").read_text()
    assert conf.endswith('hooks_dir = ["/usr/share/containers/oci/hooks.d", "/usr/local/share/avckpt/oci-hooks.d"]\n')


def test_a_unit_that_somebody_has_changed_is_kept_aside(root: Path) -> None:
    """The shipped one has a line to be uncommented (docs/events.md)."""
    unit = root / "etc/containers/systemd/avckpt-sidecar.container"
    assert not [line for line in install.install(root, quadlet=True) if line.startswith("warning")]
    shipped = unit.read_text()
    unit.write_text(shipped.replace("#Volume=", "Volume="))
    [warning] = [line for line in install.install(root) if line.startswith("warning")]
    assert "is kept as avckpt-sidecar.container.old" in warning
    aside = unit.with_name(f"{unit.name}.old")
    assert (unit.read_text(), aside.read_text()) == (shipped, shipped.replace("#Volume=", "Volume="))
    assert not [line for line in install.install(root) if line.startswith("warning")]
    install.uninstall(root)
    assert [path for path in (root / "etc/containers").rglob("*") if path.is_file()] == [aside]


def test_an_archive_of_another_image_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where there is one of that name from before, which would run instead."""

    def load(said: str) -> str:
        done = subprocess.CompletedProcess((), 0, said, "")
        monkeypatch.setattr(sidecar_image, "podman", lambda *args, **more: done)
        return sidecar_image.load(tmp_path)

    for said in (
        "Loaded image: localhost/avckpt-sidecar:latest\n",
        "Loaded image: localhost/other:1\nLoaded image: localhost/avckpt-sidecar:latest\n",
        "Loaded image(s): localhost/avckpt-sidecar:latest,localhost/other:1\n",
    ):
        assert load(said).startswith("localhost/avckpt-sidecar: loaded")
    for said in ("Loaded image: localhost/other:1\n", "Loaded image: localhost/avckpt-sidecar-build:latest\n", ""):
        with pytest.raises(ConfigError, match="holds no image localhost/avckpt-sidecar"):
            load(said)


def test_uninstall_removes_exactly_that(root: Path) -> None:
    (root / "etc/containers/containers.conf.d/60-mine.conf").write_text("[containers]\n")
    before = tree(root)
    install.install(root)
    assert tree(root) != before
    install.uninstall(root)
    assert tree(root) == before
    assert install.uninstall(root) == ["nothing is installed"]


def test_uninstall_leaves_what_others_put_there(root: Path) -> None:
    install.install(root)
    kept = [root / "run/avckpt/api.sock", root / "usr/local/share/avckpt/oci-hooks.d/mine.json"]
    for path in kept:
        path.write_text("mine")
    done = install.uninstall(root)
    assert [path.read_text() for path in kept] == ["mine", "mine"]
    assert "left /run/avckpt: it holds other files" in done
    assert not (root / "usr/local/libexec").exists()


def test_uninstall_leaves_the_program_that_running_containers_will_call(root: Path) -> None:
    before = tree(root)
    install.install(root)
    with subprocess.Popen(["sleep", "100"]) as container:
        record = Register(
            id="a" * 64, name="lidar", pid=container.pid, starttime=start_time(container.pid), bundle="", annotations={}
        )
        folder = install.under(root, Path(protocol.records_dir()))
        folder.mkdir()
        (folder / f"{record.id}.json").write_text(json.dumps(record.record()))
        done = install.uninstall(root)
        assert (
            "left /usr/local/libexec/avckpt/avckpt-hook: lidar will call it when ended; run avckpt uninstall again then"
        ) in done
        assert not (root / "etc/containers/containers.conf.d/50-avckpt.conf").exists()
        assert not (root / "usr/local/libexec/avckpt/avckpt-init").exists()
        hook = [root / "usr/local/libexec/avckpt/avckpt-hook"]
        assert "give one of" in subprocess.run(hook, capture_output=True, text=True, check=False).stderr
        assert install.uninstall(root)  # still
        assert hook[0].exists()
        container.kill()
    install.uninstall(root)
    assert tree(root) == before
    assert install.uninstall(root) == ["nothing is installed"]


@pytest.mark.parametrize("name", ["podman", "python"])
def test_services_older_than_the_drop_in_are_told(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever other processes say that their arguments are: 300 MB, of which little is read."""
    say = "import time; print(flush=True); time.sleep(1000)"
    service = [name, "-c", say, "system", "service"]
    odd = [sys.executable, "-m", "testkit.odd_environ", "300", "--arguments"]
    with (
        subprocess.Popen(service, executable=sys.executable, stdout=subprocess.PIPE) as old,
        subprocess.Popen(odd, stdout=subprocess.PIPE) as other,
    ):
        try:
            for each in (old, other):
                assert each.stdout is not None
                each.stdout.readline()
            drop_in = tmp_path / "drop-in"
            drop_in.touch()
            monkeypatch.setattr(install, "DROP_IN", drop_in)
            before_kb = peak_kb(os.getpid())
            told = [problem for problem in install.service_problems() if f"(process {old.pid})" in problem]
            assert len(told) == (name == "podman")
            assert peak_kb(os.getpid()) < before_kb + 50_000
        finally:
            old.kill()
            other.kill()


def test_again_changes_nothing_that_matters(root: Path) -> None:
    install.install(root)
    once = tree(root)
    # That a service is older than this one means that it calls no hooks.
    written_at = install.under(root, install.DROP_IN).stat().st_mtime_ns
    install.install(root)
    assert tree(root) == once
    assert install.under(root, install.DROP_IN).stat().st_mtime_ns == written_at
    install.uninstall(root)
    assert not (root / "usr/local/libexec").exists()


def test_an_upgrade_replaces_files_and_never_writes_into_them(root: Path) -> None:
    install.install(root)
    init = root / "usr/local/libexec/avckpt/avckpt-init"
    init.write_bytes(b"of an older version")
    with init.open("rb") as mounted:  # as a running container has it
        install.install(root)
        assert mounted.read() == b"of an older version"
    assert init.read_bytes() == artifacts.init_binary().read_bytes()
    assert not [name for name in tree(root) if name.endswith(".new")]


def test_an_upgrade_removes_what_only_the_old_version_had(root: Path) -> None:
    install.install(root)
    manifest = root / "usr/local/share/avckpt/manifest.json"
    old = root / "usr/local/libexec/avckpt/avckpt_hooks/old.py"
    old.write_text("")
    data = json.loads(manifest.read_text())
    data["files"].append("/usr/local/libexec/avckpt/avckpt_hooks/old.py")
    data["version"] = "0.0.1"
    manifest.write_text(json.dumps(data))
    done = install.install(root)
    assert not old.exists()
    assert any("old.py: this version has no use for it" in line for line in done)
    assert json.loads(manifest.read_text())["version"] == avckpt.__version__
    install.uninstall(root)
    assert not (root / "usr/local/libexec").exists()


def test_the_users_hook_directories_stay_in_force(root: Path) -> None:
    conf = root / "etc/containers/containers.conf"
    conf.write_text("[engine]\nhooks_dir = [\n  \"/etc/mine\", # comment\n  '/opt/other',\n]\n")
    install.install(root)
    install.install(root)
    text = (root / "etc/containers/containers.conf.d/50-avckpt.conf").read_text()
    assert text.endswith('hooks_dir = ["/etc/mine", "/opt/other", "/usr/local/share/avckpt/oci-hooks.d"]\n')
    conf.write_text('[engine]\nhooks_dir = ["/etc/new"]\n')
    install.install(root)
    text = (root / "etc/containers/containers.conf.d/50-avckpt.conf").read_text()
    assert text.endswith('hooks_dir = ["/etc/new", "/usr/local/share/avckpt/oci-hooks.d"]\n')


def test_a_configuration_that_wins_over_ours_is_said(root: Path) -> None:
    (root / "etc/containers/containers.conf.d/99-mine.conf").write_text('[engine]\nhooks_dir = ["/etc/mine"]\n')
    [warning] = [line for line in install.install(root) if line.startswith("warning: ")]
    assert warning == (
        "warning: Podman does not look into /usr/local/share/avckpt/oci-hooks.d: "
        'write hooks_dir = ["/etc/mine", "/usr/local/share/avckpt/oci-hooks.d"] '
        "under [engine] in /etc/containers/containers.conf.d/99-mine.conf"
    )


def test_another_python_of_the_system(root: Path) -> None:
    (root / "usr/bin/python3").unlink()
    (root / "usr/local/bin/python3").symlink_to(sys.executable)
    install.install(root)
    first = (root / "usr/local/libexec/avckpt/avckpt_hooks/__main__.py").read_text().splitlines()[0]
    assert first == "#!/usr/local/bin/python3 -IBS"


def test_without_a_python_nothing_is_installed(root: Path) -> None:
    """A hook that cannot start would fail every `podman run`."""
    (root / "usr/bin/python3").unlink()
    before = tree(root)
    with pytest.raises(ConfigError, match="the hooks need the system's Python"):
        install.install(root)
    assert tree(root) == before


def test_an_installation_that_breaks_off_can_be_removed(root: Path) -> None:
    (root / "usr/local/share/avckpt").mkdir(parents=True)
    (root / "usr/local/share/avckpt/oci-hooks.d").write_text("in the way")
    before = tree(root)
    with pytest.raises(ConfigError, match="cannot be written"):
        install.install(root)
    assert not (root / "etc/containers/containers.conf.d/50-avckpt.conf").exists()
    install.uninstall(root)
    assert tree(root) == before


def full_disk(root: Path) -> None:
    """In a process of its own, with `root` on a disk that has room for a new init and little more."""
    root.mkdir()
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.unshare(0x00020000) == 0  # CLONE_NEWNS
    assert libc.mount(None, b"/", None, 0x44000, None) == 0  # MS_REC | MS_PRIVATE
    assert libc.mount(b"none", str(root).encode(), b"tmpfs", 0, b"size=4m") == 0
    host(root)
    install.install(root)
    (root / "usr/local/libexec/avckpt/avckpt-init").write_bytes(b"of an older version")
    for path in (root / "usr/local/libexec/avckpt/avckpt_hooks").rglob("*.py"):
        path.write_bytes(path.read_bytes() + b"# of an older version\n")
    before = tree(root)
    room = len(artifacts.init_binary().read_bytes()) + 8_000
    with (root / "full").open("wb") as file:
        while os.statvfs(root).f_bavail * os.statvfs(root).f_bsize > room:
            file.write(bytes(4096))
            file.flush()
    with pytest.raises(
        ConfigError, match=r"/avckpt_hooks/\w+\.py cannot be written: No space left on device; nothing was changed$"
    ):
        install.install(root)
    (root / "full").unlink()
    assert tree(root) == before
    install.install(root)
    assert install.outdated(root) == []


def test_an_upgrade_on_a_full_disk_changes_nothing(tmp_path: Path) -> None:
    done = multiprocessing.get_context("fork").Process(target=full_disk, args=(tmp_path / "root",))
    done.start()
    done.join()
    assert done.exitcode == 0


def test_an_upgrade_that_breaks_off_half_way_removes_nothing(root: Path) -> None:
    install.install(root)
    before = tree(root)
    old = root / "usr/local/libexec/avckpt/avckpt_hooks/old.py"
    manifest = root / "usr/local/share/avckpt/manifest.json"
    old.write_text("")
    data = json.loads(manifest.read_text())
    data["files"].insert(0, "/usr/local/libexec/avckpt/avckpt_hooks/old.py")
    manifest.write_text(json.dumps(data))
    drop_in = root / "etc/containers/containers.conf.d/50-avckpt.conf"
    drop_in.unlink()
    drop_in.mkdir()
    with pytest.raises(ConfigError, match=f"{drop_in} cannot be written: Is a directory; only a part is in place"):
        install.install(root)
    assert old.exists()
    assert {*before} <= {*tree(root)}
    assert set(json.loads(manifest.read_text())["files"]) == set(data["files"])
    drop_in.rmdir()
    install.install(root)
    assert not old.exists()
    install.uninstall(root)
    assert not (root / "usr/local/libexec").exists()


def test_files_of_another_build_are_found(root: Path) -> None:
    install.install(root)
    assert install.outdated(root) == []
    (root / "usr/local/libexec/avckpt/avckpt-init").write_bytes(b"of an older build")
    (root / "usr/local/libexec/avckpt/avckpt_hooks/podman.py").unlink()
    assert [path.name for path in install.outdated(root)] == ["avckpt-init", "podman.py"]


def test_another_run_time_directory(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install.install(root)
    description = root / "usr/local/share/avckpt/oci-hooks.d/50-avckpt-precreate.json"
    usual = json.loads(description.read_text())
    monkeypatch.setenv("AVCKPT_RUN_DIR", "/run/other")
    assert [path.name for path in install.outdated(root)] == [description.name]
    install.install(root)
    usual["hook"]["env"].append("AVCKPT_RUN_DIR=/run/other")
    assert json.loads(description.read_text()) == usual
    assert (root / "etc/tmpfiles.d/avckpt.conf").read_text().endswith("\nd /run/other 0755 root root -\n")
    assert (root / "run/other").is_dir()
    assert install.outdated(root) == []
    monkeypatch.delenv("AVCKPT_RUN_DIR")
    install.install(root)
    assert (description.read_text(), install.outdated(root)) == (
        (artifacts.oci_hooks_source() / description.name).read_text(),
        [],
    )


def test_uninstall_is_all_or_nothing(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install.install(root)
    before = tree(root)
    rename = os.rename

    def refuse(source: Path, target: Path) -> None:
        if Path(source).name == "avckpt-init":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(source))
        rename(source, target)

    monkeypatch.setattr(os, "rename", refuse)
    with pytest.raises(ConfigError, match="avckpt-init cannot be removed: .*; nothing was changed"):
        install.uninstall(root)
    assert tree(root) == before


def test_uninstall_leaves_nothing_of_hooks_and_sidecar(root: Path) -> None:
    before = tree(root)
    install.install(root)
    folder = root / "run/avckpt"
    for name in ("containers/x.json", "health/x.json", "history.jsonl", "present.json", "starting", "lock"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("")
    with socket.socket(socket.AF_UNIX) as left_behind:
        left_behind.bind(str(folder / "api.sock"))
    (root / "run/avckpt-init").touch()  # of a container with -v /run:/run
    with (folder / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        install.uninstall(root)
        assert (folder / "history.jsonl").exists()
    assert install.uninstall(root)[:2] == ["nothing is installed", "removed /run/avckpt/history.jsonl"]
    assert install.uninstall(root) == ["nothing is installed"]
    core = folder / "cores/web.1.core.zst"
    core.parent.mkdir(parents=True)
    core.touch()
    assert install.uninstall(root)[1:] == [
        "left /run/avckpt/cores: it holds 1 core file(s), with all that the programs knew"
    ]
    core.unlink()
    assert install.uninstall(root)[1:] == ["removed /run/avckpt/cores", "removed /run/avckpt"]
    install.install(root)
    install.uninstall(root)
    assert tree(root) == before


def test_uninstall_leaves_the_runtime_that_docker_would_miss(root: Path) -> None:
    before = tree(root)
    install.install(root)
    config = root / "etc/docker/daemon.json"
    config.parent.mkdir()
    runtime = root / "usr/local/libexec/avckpt/avckpt-runtime"
    config.write_text(json.dumps({"runtimes": {"avckpt": {"path": "/usr/local/libexec/avckpt/avckpt-runtime"}}}))
    assert any("/etc/docker/daemon.json names it" in line for line in install.uninstall(root))
    done = subprocess.run([runtime, "--avckpt-runtime=/bin/echo", "kill"], capture_output=True, text=True, check=True)
    assert done.stdout == "kill\n"
    config.unlink()
    config.parent.rmdir()
    install.uninstall(root)
    assert tree(root) == before


def test_a_damaged_manifest_is_said(root: Path) -> None:
    install.install(root)
    (root / "usr/local/share/avckpt/manifest.json").write_text("{")
    for action in (install.install, install.uninstall):
        with pytest.raises(ConfigError, match="is damaged"):
            action(root)


def test_hooks_and_sidecar_are_of_one_version() -> None:
    assert avckpt.__version__ == avckpt_hooks.VERSION
