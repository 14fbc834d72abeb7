"""Programs that end while their threads work, and programs in unusual interpreters and
settings."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import v3dg
from fuzz.attacks import ends
from random_bundle import random_gaussians
from v3dg import _system
from v3dg._files import file_mode_mask

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}


def run(code, *arguments, **environment):
    """Run the code in a new Python process."""
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *arguments],
        env=ENVIRONMENT | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    shared = tmp_path_factory.mktemp("ends")
    ends.prepare(shared)
    return shared


@pytest.mark.parametrize(
    "work", ["render", "select", "rasterize", "open", "pool of a URL", "viewer"]
)
def test_program_ends_while_daemon_threads_work(files, tmp_path, work):
    if work == "viewer":
        pytest.importorskip("websockets")
    if work == "pool of a URL":
        pytest.importorskip("fsspec")
    folder = ends.copied(files, tmp_path / "work")
    outcome = ends.ended(folder, work, "return", 1 if work == "viewer" else 2, 0.05, 0.0)
    assert outcome.fault is None


@pytest.mark.parametrize("ending", ["SIGINT twice", "handler renders", "handler starts threads"])
def test_program_ends_in_any_way_while_a_pool_draws(files, tmp_path, ending):
    folder = ends.copied(files, tmp_path / "work")
    assert ends.ended(folder, "pools of renderers", ending, 2, 0.02, 0.02).fault is None


UNMADE = """
    import inspect
    from v3dg import _core

    classes = [c for c in vars(_core).values() if isinstance(c, type)]
    functions = [f for f in vars(_core).values() if inspect.isbuiltin(f)]
    assert classes and functions

    def refuses(call, what):
        try:
            call()
        except TypeError:
            return
        raise SystemExit(f"{what} is not refused")

    num_checked = 0
    for cls in classes:
        try:
            unmade = cls.__new__(cls)
        except TypeError:
            continue
        for name in vars(cls):
            member = inspect.getattr_static(cls, name)
            if name.startswith("__") and name not in ("__len__", "__getitem__"):
                continue
            num_checked += 1
            if isinstance(member, property):
                refuses(lambda: getattr(unmade, name), f"{cls.__name__}.{name}")
                continue
            for count in range(14):
                refuses(lambda: getattr(unmade, name)(*[None] * count), f"{cls.__name__}.{name}")
        for function in functions:
            for count in range(1, 14):
                refuses(lambda: function(*[unmade] * count), function.__name__)
    assert num_checked > 50
"""


def test_objects_that_new_alone_made_are_refused():
    done = run(UNMADE)
    assert done.returncode == 0, done.stderr


def test_sub_interpreters_are_refused_at_once():
    code = """
        try:
            import _interpreters as interpreters
        except ImportError:
            import _xxsubinterpreters as interpreters
        interpreters.run_string(interpreters.create(), '''
        try:
            import v3dg
        except ImportError as error:
            print(error, flush=True)
        '''.replace(" " * 8, ""))
    """
    done = run(code)
    assert "v3dg: expected the main interpreter of a process, got a sub-interpreter" in done.stdout


PARALLEL = """
    import sys, numpy as np, v3dg
    from v3dg.donut import make_donut

    asset = make_donut(3000, seed=0)
    config = v3dg.BuildConfig(steps=1, num_views=2, cluster_size=64)
    bundle = v3dg.build_bundle(asset, config=config, device="cpu", progress=False)
    camera = v3dg.Camera.look_at((0, -3, 1), (0, 0, 0), width=90, height=60)
    image = v3dg.render(bundle, camera, device="cpu")
    v3dg.write_asset(sys.argv[1], asset)
    assert len(v3dg.read_asset(sys.argv[1])) == len(asset)
    print(image.color.sum())
"""


@pytest.mark.parametrize(
    "setting",
    [
        "OMP_NUM_THREADS=100000",
        "OMP_NUM_THREADS=100000,3",
        "OMP_NUM_THREADS=-3",
        "OMP_STACKSIZE=16k",
        "OMP_STACKSIZE=65536B",
        "OMP_STACKSIZE=900G",
        "OMP_THREAD_LIMIT=1",
        "OMP_THREAD_LIMIT=-1",
    ],
)
def test_settings_of_openmp_that_fit_no_machine_are_survived(tmp_path, setting):
    name, _, value = setting.partition("=")
    done = run(PARALLEL, str(tmp_path / "a.ply"), **{name: value})
    assert done.returncode == 0, done.stderr
    assert done.stdout == run(PARALLEL, str(tmp_path / "a.ply"), OMP_NUM_THREADS="1").stdout


@pytest.mark.parametrize("columns", ["1", "5", "12"])
def test_help_fits_terminals_of_few_columns(columns):
    done = run("from v3dg.cli import main; main(['build', '--help'])", COLUMNS=columns)
    assert done.returncode == 0
    assert "--cluster-size" in done.stdout
    assert len(done.stdout.splitlines()) < 300


def test_masks_of_modes_are_the_same_without_proc():
    before = os.umask(0o027)
    try:
        assert file_mode_mask() == 0o027
        assert file_mode_mask("/nothing/status") == 0o027
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)


def test_a_build_needs_no_proc(tmp_path):
    """A folder without access is mounted over /proc, in a separate mount namespace."""
    v3dg.write_asset(tmp_path / "a.ply", random_gaussians(np.random.default_rng(0), 500, 0))
    alone = ["unshare", "--mount", "--map-root-user"]
    if subprocess.run([*alone, "true"], capture_output=True, check=False).returncode != 0:
        pytest.skip("namespaces of mounts are not allowed here")
    build = f"{sys.executable} -m v3dg build a.ply -o a.v3dg --device cpu --quiet"
    script = f"mount -t tmpfs none /proc && test ! -e /proc/self && {build}"
    done = subprocess.run(
        [*alone, "sh", "-c", script], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(v3dg.Bundle.open(tmp_path / "a.v3dg").clusters) > 0


def test_memory_is_told_without_proc():
    assert _system.resident_memory("/nothing/statm") >= _system.resident_memory() // 2 > 0
