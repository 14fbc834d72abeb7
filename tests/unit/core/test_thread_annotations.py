"""Clang proves that guarded fields are only used while their mutex is locked.

`.ci/check_threads.py` runs clang. The tests also run it on copies of the sources in
which one lock is removed, which it must detect.
"""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CSRC = ROOT / "csrc"
CHECK = ROOT / ".ci" / "check_threads.py"
needs_clang = pytest.mark.skipif(
    shutil.which(os.environ.get("CLANG", "clang++")) is None,
    reason="clang++ is not installed, which alone checks the annotations",
)


def check(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(CHECK), *words],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def has_cuda_headers() -> bool:
    spec = importlib.util.spec_from_file_location("check_threads", CHECK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.cuda_headers() is not None


@needs_clang
def test_mutexes_are_held_where_they_have_to_be():
    result = check()
    assert result.returncode == 0, result.stderr
    assert re.search(r"^\d+ sources with mutexes checked, 0 wrong$", result.stdout, re.MULTILINE)


def test_sources_with_mutexes_are_found_through_headers():
    sources = check("--list").stdout.split()
    assert {"residency/page_pool.cpp", "residency/pool_readers.cpp"} <= set(sources)
    assert {"io/hashed_read.cpp", "bindings/host_frame.cpp"} <= set(sources)


def test_headers_that_no_source_includes_are_checked_alone():
    assert "base/ahead.h" in check("--list").stdout.split()


# base/mutex.h wraps the types of the standard library. In the other file, a child of
# fork() constructs the mutex again.
UNCHECKED = {"base/mutex.h", "bindings/python_lock.cpp"}


def test_clang_knows_every_mutex():
    unknown = re.compile(r"std::(mutex|unique_lock|lock_guard|scoped_lock|condition_variable)\b")
    sources = [path for path in CSRC.rglob("*") if path.suffix in {".h", ".cpp"}]
    users = {p for p in sources if unknown.search(p.read_text(encoding="utf-8"))}
    assert {str(path.relative_to(CSRC)) for path in users} == UNCHECKED


# For each fault: the text that is removed, its file, the source that is then checked,
# and the warning of clang.
BROKEN = {
    "a caller that does not lock": (
        "residency/page_pool.cpp",
        "    const PoolLock lock(shared);\n    return state_->readers",
        "    return state_->readers",
        "residency/page_pool.cpp",
        "calling function 'read_some' requires holding mutex",
    ),
    "a guarded field without the lock": (
        "residency/pool_frames.cpp",
        "    const PoolLock lock(shared);\n    exchange(shared);\n",
        "",
        "residency/pool_frames.cpp",
        "requires holding mutex 'shared.busy'",
    ),
    "a read from disk under the lock": (
        "residency/pool_readers.cpp",
        "    const MutexUnlock unlocked(shared.busy);\n",
        "",
        "residency/pool_readers.cpp",
        "cannot call function 'read_batch' while mutex 'shared.busy' is held",
    ),
    "a frame that goes on without the lock": (
        "residency/pool_frames.cpp",
        "    if (!shared.lock_at_once()) return;\n",
        "    static_cast<void>(shared.lock_at_once());\n",
        "residency/pool_frames.cpp",
        "requires holding mutex 'shared.busy'",
    ),
    "a function that forgets what it requires": (
        "residency/pool_decider.h",
        "    void decide(PoolShared& shared) V3DG_REQUIRES(shared.busy);",
        "    void decide(PoolShared& shared);",
        "residency/pool_decider.cpp",
        "requires holding mutex 'shared.busy'",
    ),
    "a file that is hashed while it is read": (
        "io/hashed_read.cpp",
        "    const MutexLock lock(busy_);\n    while",
        "    while",
        "io/hashed_read.cpp",
        "requires holding mutex 'busy_'",
    ),
    "an item that is consumed without the lock": (
        "base/ahead.h",
        "        const MutexLock lock(busy_);\n        is_made_[used_++",
        "        is_made_[used_++",
        "base/ahead.h",
        "requires holding mutex 'busy_'",
    ),
    "an error that is stored without the lock": (
        "base/first_error.h",
        "        const MutexLock lock(mutex_);\n        if (error_ &&",
        "        if (error_ &&",
        "base/first_error.h",
        "requires holding mutex 'mutex_'",
    ),
    "a kernel's limit that is read without the lock": (
        "base/device.cpp",
        "    const MutexLock lock(mutex);\n    size_t& allowed",
        "    size_t& allowed",
        "base/device.cpp",
        "requires holding mutex 'mutex'",
    ),
    "a lock of a stream that does not lock": (
        "base/device.cpp",
        "    busy_.lock();\n    if (is_captured",
        "    if (is_captured",
        "base/device.cpp",
        "requires holding mutex 'busy_'",
    ),
    "a turn that does not wait for the mutex": (
        "bindings/drawing.h",
        "        mutex.lock();\n",
        "",
        "bindings/drawing.h",
        "mutex 'mutex' is not held on every path",
    ),
    "models that are set while a frame is drawn": (
        "bindings/cuda_frame.cpp",
        "        const Turn turn(*turns_);\n        frame_.set_models(",
        "        frame_.set_models(",
        "bindings/cuda_frame.cpp",
        "requires holding mutex 'turns_",
    ),
    "a frame on the host": (
        "bindings/host_frame.cpp",
        "        const MutexLock lock(busy_);\n",
        "",
        "bindings/host_frame.cpp",
        "requires holding mutex 'busy_'",
    ),
}

USERS_OF_CUDA = ("base/device.cpp", "bindings/cuda_frame.cpp")


@needs_clang
@pytest.mark.parametrize("name", BROKEN)
def test_missing_lock_is_found(tmp_path, name):
    changed, text, replacement, source, message = BROKEN[name]
    if source.startswith("bindings/") and importlib.util.find_spec("pybind11") is None:
        pytest.skip("pybind11 is not installed, without which bindings cannot be read")
    if source in USERS_OF_CUDA and not has_cuda_headers():
        pytest.skip("CUDA's headers are not installed, without which its sources cannot be read")
    shutil.copytree(CSRC, tmp_path / "csrc")
    path = tmp_path / "csrc" / changed
    before = path.read_text(encoding="utf-8")
    assert before.count(text) == 1
    path.write_text(before.replace(text, replacement), encoding="utf-8")
    result = check("--csrc", str(tmp_path / "csrc"), source)
    assert result.returncode == 1
    assert message in result.stderr


def test_missing_clang_is_told():
    result = check("residency/pool_shared.cpp", CLANG="no-such-clang")
    assert result.returncode == 2
    assert result.stderr == (
        "CLANG: expected a clang++, got 'no-such-clang'; install clang, or set CLANG to its name\n"
    )
