"""The package works without the functions that Windows lacks, which are removed from
this Python. `_files` and `_system` are also tested alone."""

import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import numpy as np
import pytest

import v3dg
from v3dg import _files, _system, _windows
from v3dg.export._below import Folder

# Removes the functions of POSIX that Windows lacks, after the standard library has
# looked at them, and adds msvcrt, whose locks are those of POSIX here.
WINDOWS = """
import asyncio, multiprocessing.connection, multiprocessing.resource_tracker, os, signal
import shutil, socket, subprocess, sys, tempfile, types
import _signal
import fcntl as posix
import numpy

msvcrt = types.ModuleType("msvcrt")
msvcrt.LK_NBLCK = 2
def locking(descriptor, mode, size):
    start = os.lseek(descriptor, 0, os.SEEK_CUR)
    posix.lockf(descriptor, posix.LOCK_EX | posix.LOCK_NB, size, start, os.SEEK_SET)
msvcrt.locking = locking
sys.modules["msvcrt"] = msvcrt
for name in ("fcntl", "resource", "pwd", "grp"):
    sys.modules[name] = None
for name in (
    "pread preadv pwrite pwritev fchmod fchown fstatvfs statvfs register_at_fork sysconf "
    "sched_getaffinity fork O_NOFOLLOW O_NONBLOCK O_DIRECTORY O_CLOEXEC"
).split():
    delattr(os, name)
os.supports_dir_fd = set()
for name in "pthread_sigmask setitimer SIGALRM SIGKILL SIGHUP".split():
    delattr(signal, name)
    delattr(_signal, name)
os.sep  # paths stay those of this system
"""


def run(code, folder, *arguments):
    """Run code in a process without the functions that Windows lacks."""
    root = Path(v3dg.__file__).parents[1]
    program = f"{WINDOWS}\nsys.path.insert(0, {str(root)!r})\n{textwrap.dedent(code)}"
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


MAKE_BUNDLE = """
import numpy as np
import v3dg
from v3dg import _files, _system

rng = np.random.default_rng(0)
n = 2000
asset = v3dg.Gaussians(
    means=rng.normal(size=(n, 3)).astype(np.float32),
    quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
    scales=np.full((n, 3), 0.05, np.float32),
    opacities=np.full(n, 0.8, np.float32),
    sh=rng.normal(size=(n, 1, 3)).astype(np.float32),
)
v3dg.write_asset("a.ply", asset)
config = v3dg.BuildConfig(cluster_size=64, steps=2, first_steps=2)
bundle = v3dg.build_bundle(
    "a.ply", config=config, device="cpu", resume_path="a.v3dg", quality="draft", progress=False
)
camera = v3dg.turntable((0, 0, 0), 6, 1, width=64, height=48)[0]
"""


def test_a_build_a_picture_and_an_export_need_no_posix(tmp_path):
    code = """
    assert not _files.HAS_FOLDER_DESCRIPTORS and _system.SIGNALS == (signal.SIGINT,)
    opened = v3dg.open("a.v3dg")
    image = v3dg.render(opened, camera, device="cpu")
    opened.write("b.v3dg")
    v3dg.write_tiles(opened, "tiles")
    v3dg.write_tiles(opened, "tiles")
    print(image.color.mean() > 0, len(os.listdir("tiles")) > 0)
    """
    done = run(MAKE_BUNDLE + textwrap.dedent(code), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "True True\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.ply",
        "a.v3dg",
        "b.v3dg",
        "tiles",
    ]
    assert (tmp_path / "a.v3dg").read_bytes() == (tmp_path / "b.v3dg").read_bytes()


def test_a_second_build_is_refused_without_posix(tmp_path):
    code = """
    from v3dg import _files
    if len(sys.argv) > 1:
        with _files.locked_folder("scratch", "scratch"):
            raise SystemExit
    descriptor = os.open("file", os.O_RDWR | os.O_CREAT)
    _files.lock(descriptor, "file")
    os.mkdir("scratch")
    with _files.locked_folder("scratch", "scratch"):
        second = subprocess.run([sys.executable, "-c", sys.orig_argv[2], "again"], text=True,
                                stderr=subprocess.PIPE)
    print(second.returncode, second.stderr.splitlines()[-1])
    with _files.locked_folder("scratch", "scratch"):
        print("free again", os.path.getsize("file"))
    """
    done = run(code, tmp_path)
    assert done.stdout.splitlines() == [
        "1 RuntimeError: scratch: another build is using it; wait for it, or write to another "
        "place",
        "free again 0",
    ], done.stderr


def test_ctrl_c_is_raised_again_without_timers(tmp_path):
    code = """
    import time
    from v3dg import _system
    try:
        _system.interrupt_soon()
        time.sleep(10)
    except KeyboardInterrupt:
        print("interrupted")
    """
    assert run(code, tmp_path).stdout == "interrupted\n"


@pytest.fixture
def no_offsets(monkeypatch):
    """Remove reads and writes at offsets."""
    monkeypatch.delattr("os.preadv")
    monkeypatch.delattr("os.pwrite")


def test_reads_at_offsets_of_many_threads_do_not_mix(no_offsets, tmp_path):
    content = np.arange(20000, dtype=np.uint32)
    with open(tmp_path / "numbers", "w+b") as file:
        _files.write_at(file.fileno(), content.tobytes(), 0)
        wrong = []

        def read(first):
            out = np.empty(100, np.uint32)
            for start in range(first, 19000, 800):
                is_whole = _files.read_at(file.fileno(), out, 4 * start)
                if not is_whole or not np.array_equal(out, content[start : start + 100]):
                    wrong.append(start)

        threads = [threading.Thread(target=read, args=(k,)) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert _files.read_bytes_at(file.fileno(), 8, 4 * 19999) == content[-1:].tobytes()
        assert not _files.read_at(file.fileno(), np.empty(2, np.uint32), 4 * 19999)


def test_a_file_is_replaced_without_permissions(monkeypatch, tmp_path):
    monkeypatch.delattr("os.fchown")
    monkeypatch.delattr("os.fchmod")
    for text in ("first", "second"):
        with _files.replacing(tmp_path / "a") as temporary:
            Path(temporary).write_text(text)
    assert (tmp_path / "a").read_text() == "second"
    assert len(list(tmp_path.iterdir())) == 1


def test_no_link_is_followed_without_descriptors_of_folders(monkeypatch, tmp_path):
    monkeypatch.setattr(_files, "HAS_FOLDER_DESCRIPTORS", False)
    outside = tmp_path / "outside"
    root = tmp_path / "root"
    (outside / "below").mkdir(parents=True)
    (root / "folder").mkdir(parents=True)
    (outside / "secret").write_text("secret")
    (root / "link").symlink_to(outside)
    (root / "folder" / "file").symlink_to(outside / "secret")
    (root / "plain").write_text("plain")
    with Folder(root, Path("shown")) as folder:
        assert sorted(folder.names()) == ["folder", "link", "plain"]
        folder.move("plain", "folder/new/plain")
        assert (root / "folder" / "new" / "plain").read_text() == "plain"
        with pytest.raises(NotADirectoryError, match="shown/link/secret"):
            folder.open_file("link/secret")
        with pytest.raises(NotADirectoryError):
            folder.move("folder/new/plain", "link/plain")
        with pytest.raises(OSError, match="shown/folder/file"):
            folder.open_file("folder/file")
        assert folder.status("folder/missing") is None
    assert sorted(path.name for path in outside.iterdir()) == ["below", "secret"]


def test_memory_is_reported_without_proc(monkeypatch):
    total = _system.available_memory()
    monkeypatch.setattr("builtins.open", no_proc(open))
    assert _system.available_memory() >= total // 2 > 0
    assert _system.resident_memory() > 1 << 20


def no_proc(original):
    def opened(path, *arguments, **options):
        if str(path).startswith("/proc/"):
            raise FileNotFoundError(path)
        return original(path, *arguments, **options)

    return opened


def test_structures_of_windows_have_their_documented_sizes():
    """MEMORYSTATUSEX and PROCESS_MEMORY_COUNTERS on 64-bit Windows."""
    assert _windows.ctypes.sizeof(_windows._MemoryStatus) == 64
    assert _windows.ctypes.sizeof(_windows._ProcessMemory) == 72
    assert _windows._MemoryStatus.available.offset == 16
    assert _windows._ProcessMemory.resident.offset == 16
