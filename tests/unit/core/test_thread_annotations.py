"""Clang proves that what a mutex guards is used while the mutex is held.

`.ci/check_threads.py` runs it, and here it is also given copies of the sources in which
one lock is gone: it has to notice each.
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


@needs_clang
def test_mutexes_are_held_where_they_have_to_be():
    result = check()
    assert result.returncode == 0, result.stderr
    assert re.search(r"^\d+ sources with mutexes checked, 0 wrong$", result.stdout, re.MULTILINE)


def test_sources_with_mutexes_are_found_through_headers():
    sources = check("--list").stdout.split()
    assert {"residency/page_pool.cpp", "residency/pool_readers.cpp"} <= set(sources)
    assert {"io/hashed_read.cpp", "bindings/host_frame.cpp"} <= set(sources)


@pytest.mark.parametrize("folder", ["residency", "io"])
def test_folder_has_no_mutex_that_clang_does_not_know(folder):
    unknown = re.compile(r"std::(mutex|unique_lock|lock_guard|scoped_lock|condition_variable)\b")
    sources = [path for path in (CSRC / folder).iterdir() if path.suffix in {".h", ".cpp"}]
    assert [p.name for p in sources if unknown.search(p.read_text(encoding="utf-8"))] == []


# What is removed, from where, which source is checked then, and what clang says.
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
    "a frame on the host": (
        "bindings/host_frame.cpp",
        "        const MutexLock lock(busy_);\n",
        "",
        "bindings/host_frame.cpp",
        "requires holding mutex 'busy_'",
    ),
}


@needs_clang
@pytest.mark.parametrize("name", BROKEN)
def test_missing_lock_is_found(tmp_path, name):
    changed, text, replacement, source, message = BROKEN[name]
    if source.startswith("bindings/") and importlib.util.find_spec("pybind11") is None:
        pytest.skip("pybind11 is not installed, without which bindings cannot be read")
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
