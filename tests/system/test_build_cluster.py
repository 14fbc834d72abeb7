"""Builds that run on executors: on processes, and on a dask cluster in which a worker
is killed."""

import asyncio
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import ENVIRONMENT, PACKAGE, fails, run
from v3dg import BuildConfig, _core, build_bundle
from v3dg.levels import build_file, levels_path, scheduler

CONFIG = BuildConfig(cluster_size=32, steps=150, first_steps=150)
OPTIONS = {"config": CONFIG, "progress": False, "device": "cpu"}
PATIENCE = 120


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An asset of 16 units, and the bundle that a single process builds from it."""
    folder = tmp_path_factory.mktemp("cluster")
    v3dg.write_asset(folder / "a.ply", make_asset(num_gaussians=6000, seed=0))
    with small_units():
        build_file(folder / "a.ply", folder / "local.v3dg", **OPTIONS)
    return folder


@contextmanager
def small_units():
    """Set the size of units in the driver only. Workers receive it in the plan of their
    unit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3dg.levels.whole.UNIT_LEAVES", 500)
        yield


def build_on(executor, folder, output, **options):
    with small_units():
        build_file(folder / "a.ply", output, executor=executor, **OPTIONS, **options)
    assert output.read_bytes() == (folder / "local.v3dg").read_bytes()
    assert {path.name for path in output.parent.iterdir()} == {output.name}


def spawned_processes(count):
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))


# ---- any executor


@pytest.fixture
def at_package(monkeypatch):
    """Let spawned processes import the package under test."""
    monkeypatch.setenv("PYTHONPATH", PACKAGE)


def test_processes_build_the_same_bytes(folder, tmp_path, at_package):
    with spawned_processes(2) as executor:
        build_on(executor, folder, tmp_path / "out.v3dg")


def test_units_of_an_asset_in_memory_go_along(folder, tmp_path, at_package):
    asset = v3dg.read_asset(folder / "a.ply")
    with spawned_processes(1) as executor, small_units():
        with pytest.raises(
            ValueError, match="resume_path: expected a file on a disk that all workers"
        ):
            build_bundle(asset, executor=executor, **OPTIONS)
        bundle = build_bundle(asset, executor=executor, resume_path=tmp_path / "out", **OPTIONS)
    assert bundle.path == str(tmp_path / "out")
    assert (tmp_path / "out").read_bytes() == (folder / "local.v3dg").read_bytes()


def test_processes_round_as_one_does(folder, tmp_path, at_package):
    asset = v3dg.read_asset(folder / "a.ply")
    with small_units(), spawned_processes(2) as executor:
        build_bundle(asset, codec="quantized", **OPTIONS).write(tmp_path / "alone.v3dg")
        options = {"executor": executor, "resume_path": tmp_path / "out"}
        build_bundle(asset, codec="quantized", **options, **OPTIONS)
    assert (tmp_path / "out").read_bytes() == (tmp_path / "alone.v3dg").read_bytes()


def test_a_process_that_dies_leaves_what_can_be_gone_on_with(folder, tmp_path, at_package):
    output = tmp_path / "out.v3dg"
    with spawned_processes(1) as executor:
        executor.submit(os.getpid).result()
        (pid,) = executor._processes
        killer = Killer(lambda: is_journal_longer(output, folder) and pid)
        with killer, small_units(), pytest.raises(RuntimeError, match="terminated abruptly"):
            build_file(folder / "a.ply", output, executor=executor, **OPTIONS)
    assert levels_path(output).exists()
    with ThreadPoolExecutor(2) as executor:
        build_on(executor, folder, output, resume=True)


def test_an_executor_goes_on_in_the_midst_of_units(folder, tmp_path, monkeypatch):
    """The executor continues a build that was interrupted in one process."""
    output = tmp_path / "out.v3dg"
    left = [8]
    simplify = v3dg.levels.simplify.LevelBuilder._simplify

    def some(*arguments):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return simplify(*arguments)

    with small_units(), monkeypatch.context() as patch:
        patch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", some)
        with pytest.raises(KeyboardInterrupt):
            build_file(folder / "a.ply", output, **OPTIONS)
    with ThreadPoolExecutor(2) as executor:
        build_on(executor, folder, output, resume=True)


def test_workers_of_another_kind_are_refused(folder, tmp_path, at_package, monkeypatch):
    if _core.isa() == "baseline":
        pytest.skip("expected a processor with AVX2")
    monkeypatch.setenv("V3DG_ISA", "baseline")
    with (
        spawned_processes(1) as executor,
        small_units(),
        pytest.raises(
            RuntimeError, match=rf"worker on {socket.gethostname()}: expected \w+ with v3dg .*, got"
        ),
    ):
        build_file(folder / "a.ply", tmp_path / "out.v3dg", executor=executor, **OPTIONS)
    assert list(tmp_path.iterdir()) == []


def test_workers_that_do_not_reach_the_folder_say_so(folder, tmp_path, at_package):
    class Elsewhere(Executor):
        def submit(self, fn, task, *arguments):
            object.__setattr__(task.pages, "path", Path("/elsewhere/out.v3dg.partial"))
            return pool.submit(fn, task, *arguments)

    with (
        spawned_processes(1) as pool,
        small_units(),
        pytest.raises(
            RuntimeError, match=r"/elsewhere/out.v3dg.partial does not exist there; put resume_path"
        ),
    ):
        build_file(folder / "a.ply", tmp_path / "out.v3dg", executor=Elsewhere(), **OPTIONS)


class Interrupted(Executor):
    """An executor that finishes two units, accepts three more, and is then
    interrupted."""

    def __init__(self):
        self.futures = []

    def submit(self, fn, *arguments):
        self.futures.append(Future())
        if len(self.futures) <= 2:
            self.futures[-1].set_result(fn(*arguments))
        if len(self.futures) == 6:
            raise KeyboardInterrupt
        return self.futures[-1]


def test_an_interrupt_cancels_what_waits(folder, tmp_path):
    executor = Interrupted()
    with small_units(), pytest.raises(KeyboardInterrupt):
        build_file(folder / "a.ply", tmp_path / "out.v3dg", executor=executor, **OPTIONS)
    assert [future.cancelled() for future in executor.futures[:5]] == [
        False,
        False,
        True,
        True,
        True,
    ]


# ---- dask


def is_journal_longer(output, folder):
    """Return whether the journal contains a finished unit."""
    path = levels_path(output)
    return path.exists() and path.stat().st_size > (folder / "local.v3dg").stat().st_size


class Killer:
    """A thread that kills a process as soon as a function returns the process's
    number."""

    def __init__(self, victim):
        self.killed = None
        self._victim = victim
        self._thread = threading.Thread(target=self._run)
        self._is_over = False

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._is_over = True
        self._thread.join()

    def _run(self):
        while self.killed is None and not self._is_over:
            if pid := self._victim():
                os.kill(pid, signal.SIGKILL)
                self.killed = pid
            time.sleep(0.005)


@contextmanager
def cluster(folder, num_workers):
    """The addresses of a scheduler and of workers in separate processes."""
    environment = ENVIRONMENT | {"OMP_NUM_THREADS": "1", "DASK_DISTRIBUTED__ADMIN__LOG_LENGTH": "0"}
    options = {
        "cwd": folder,
        "env": environment,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    dask = [sys.executable, "-m", "dask"]
    file = folder / "scheduler.json"
    processes = []
    try:
        for command in (
            [
                "scheduler",
                "--port",
                "0",
                "--no-dashboard",
                "--host",
                "127.0.0.1",
                "--scheduler-file",
                file,
            ],
            *[
                [
                    "worker",
                    "--scheduler-file",
                    file,
                    "--no-nanny",
                    "--no-dashboard",
                    "--nthreads",
                    "1",
                ]
            ]
            * num_workers,
        ):
            processes.append(subprocess.Popen([*dask, *map(str, command)], **options))
        end = time.monotonic() + PATIENCE
        while not file.exists():
            assert time.monotonic() < end, "no scheduler"
            time.sleep(0.05)
        yield file
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


@pytest.mark.slow
def test_a_dask_cluster_builds_the_same_bytes_though_a_worker_is_killed(folder, tmp_path):
    distributed = pytest.importorskip("distributed")
    (tmp_path / "dask").mkdir()
    (tmp_path / "out").mkdir()
    output = tmp_path / "out" / "out.v3dg"
    with (
        cluster(tmp_path / "dask", 4) as file,
        distributed.Client(scheduler_file=str(file), timeout=PATIENCE) as client,
    ):
        client.wait_for_workers(4, timeout=PATIENCE)
        pids = client.run(os.getpid)

        def busy():
            """Return a worker that builds a unit while another unit is finished."""
            if not is_journal_longer(output, folder):
                return None
            return next(
                (pids[worker] for worker, tasks in client.processing().items() if tasks), None
            )

        with Killer(busy) as killer:
            build_on(client.get_executor(), folder, output)
        assert killer.killed in pids.values()
        assert len(client.scheduler_info()["workers"]) == 3
        # The command also submits whole units.
        address = client.scheduler.address
        for name, options in (("dask", ["--scheduler", address]), ("here", [])):
            done = run(
                "build", folder / "a.ply", "-o", tmp_path / f"{name}.v3dg", "--quiet", *options
            )
            assert done.returncode == 0, done.stderr
        assert (tmp_path / "dask.v3dg").read_bytes() == (tmp_path / "here.v3dg").read_bytes()


class Meddler(threading.Thread):
    """A thread that stops or kills a scheduler as soon as a unit is finished."""

    def __init__(self, output, folder, action):
        super().__init__(daemon=True)
        self._is_time = lambda: is_journal_longer(output, folder)
        self._action = action

    def run(self):
        while not self._is_time():
            time.sleep(0.005)
        self._action()


@pytest.fixture
def meddled_build(folder, tmp_path):
    """Build on a cluster whose scheduler is disturbed meanwhile. Return also its
    address."""
    distributed = pytest.importorskip("distributed")
    (tmp_path / "dask").mkdir()
    (tmp_path / "out").mkdir()
    output = tmp_path / "out" / "out.v3dg"
    with cluster(tmp_path / "dask", 1) as file:
        client = distributed.Client(scheduler_file=str(file), timeout=PATIENCE)
        client.wait_for_workers(1, timeout=PATIENCE)
        pid, address = client.run_on_scheduler(os.getpid), client.scheduler.address

        def build(action):
            Meddler(output, folder, lambda: action(pid)).start()
            build_on(client.get_executor(), folder, output)

        yield build, output, address
        begin = time.monotonic()
        client.close()
        # the build also ends if the scheduler does not answer
        assert time.monotonic() - begin < 30


def goes_on_alone(folder, output):
    """Return whether finished units exist, so that a build without the scheduler can
    continue from them."""
    assert levels_path(output).exists()
    with ThreadPoolExecutor(2) as executor:
        build_on(executor, folder, output, resume=True)


@pytest.mark.slow
def test_a_scheduler_that_stops_in_the_midst_is_not_waited_for(meddled_build, folder, monkeypatch):
    build, output, address = meddled_build
    monkeypatch.setattr("v3dg.levels.scheduler._MOST_SILENCE_S", 4)
    monkeypatch.setattr("v3dg.levels.scheduler._TICK_S", 0.5)
    with pytest.raises(
        RuntimeError, match=rf"^scheduler {address}: no answer for 4 s; .*units are kept"
    ):
        build(lambda pid: os.kill(pid, signal.SIGSTOP))
    goes_on_alone(folder, output)


@pytest.mark.slow
def test_a_scheduler_that_is_slow_to_answer_is_waited_for(meddled_build, monkeypatch):
    monkeypatch.setattr("v3dg.levels.scheduler._MOST_SILENCE_S", 30)
    monkeypatch.setattr("v3dg.levels.scheduler._TICK_S", 0.2)
    build, _, _ = meddled_build
    went_on = threading.Event()

    def stop_for_a_while(pid):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(6)
        os.kill(pid, signal.SIGCONT)
        went_on.set()

    build(stop_for_a_while)
    assert went_on.is_set()


@pytest.mark.slow
def test_a_scheduler_that_dies_in_the_midst_is_named(meddled_build, folder):
    build, output, address = meddled_build
    with pytest.raises(RuntimeError, match=rf"^scheduler {address}: connection lost"):
        build(lambda pid: os.kill(pid, signal.SIGKILL))
    goes_on_alone(folder, output)


class Client:
    """A client of a scheduler that answers only some of the requests."""

    status = "running"

    def __init__(self, answers):
        self.scheduler = self
        self.address = "tcp://127.0.0.1:1"
        self.num_asked = 0
        self._answers = iter(answers)
        self.loop = self
        self.asyncio_loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.asyncio_loop.run_forever)
        self._thread.start()

    async def ncores(self, workers):
        self.num_asked += 1
        if not next(self._answers):
            raise OSError("no answer")

    def close(self):
        self.asyncio_loop.call_soon_threadsafe(self.asyncio_loop.stop)
        self._thread.join()
        self.asyncio_loop.close()


def test_only_silence_without_a_break_ends_a_wait():
    """If a scheduler answers, for example, every tenth request, the build waits for any
    length of time."""
    client = Client([number % 10 == 9 for number in range(40)] + [False] * 100)
    try:
        watch = scheduler.Watch(client)

        def wait_for_long():
            for _ in range(100):
                watch.tick()
                while watch._question is not None and not watch._question.done():
                    time.sleep(0.001)

        with pytest.raises(
            scheduler.SchedulerError, match=r"^scheduler tcp://127.0.0.1:1: no answer for"
        ):
            wait_for_long()
        assert 40 <= client.num_asked <= 40 + 2 + scheduler._MOST_SILENCE_S / scheduler._TICK_S
    finally:
        client.close()


@contextmanager
def serving(answer):
    """Yield the address of a server that sends this to every client."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with connection:
                        connection.recv(8)
                        connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize(
    "answer",
    [
        b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n",
        b"SSH-2.0-OpenSSH_9.2\r\n",
        b"\x15\x03\x01\x00\x02\x02\x46" * 9,
        bytes(100),
    ],
    ids=["web", "ssh", "tls", "zeros"],
)
def test_a_server_of_another_kind_is_no_scheduler(tmp_path, answer):
    pytest.importorskip("distributed")
    v3dg.write_asset(tmp_path / "a.ply", make_asset(num_gaussians=1000, seed=0))
    with serving(answer) as address:
        expected = (
            f"{address}: expected a dask scheduler, got a server that speaks another protocol; "
            "pass the"
        )
        fails(1, expected, "build", "a.ply", "--scheduler", address, cwd=tmp_path)


@pytest.mark.parametrize(
    "address", ["", "nowhere", "http://127.0.0.1:80", "tcp://127.0.0.1", "tcp://["]
)
def test_what_is_no_address_is_told_so(address):
    pytest.importorskip("distributed")
    from v3dg.cli import build

    with (
        pytest.raises(
            RuntimeError,
            match=r"expected a dask scheduler such as tcp://host:8786, got an invalid address",
        ),
        build._executor_at(address),
    ):
        pass


def test_a_lost_scheduler_ends_a_run_over_many_assets(tmp_path, monkeypatch):
    """If the run continued, each of the other assets would wait as long for the
    scheduler."""
    from v3dg.cli import main

    built = []

    def fail(paths, *_, **__):
        built.append(paths)
        raise scheduler.SchedulerError("scheduler tcp://a:1: no answer for 120 s")

    monkeypatch.setattr("v3dg.cli.build.build_file", fail)
    for name in ("a", "b", "c"):
        v3dg.write_asset(tmp_path / f"{name}.ply", make_asset(num_gaussians=1000, seed=0))
    assert main(["build", str(tmp_path), "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert len(built) == 1


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    v3dg.write_asset(tmp_path / "a.ply", make_asset(num_gaussians=1000, seed=0))
    monkeypatch.setattr("v3dg.cli.build._PATIENCE_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        from v3dg.cli import build

        with (
            pytest.raises(
                RuntimeError, match=f"^{address}: expected a dask scheduler that answers, got none"
            ),
            build._executor_at(address),
        ):
            pass
    fails(
        1,
        "nowhere: expected a dask scheduler",
        "build",
        "a.ply",
        "--scheduler",
        "nowhere",
        cwd=tmp_path,
    )


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    v3dg.write_asset(tmp_path / "a.ply", make_asset(num_gaussians=1000, seed=0))
    monkeypatch.setitem(sys.modules, "distributed", None)
    from v3dg.cli import build

    with (
        pytest.raises(
            ImportError,
            match=r"builds on many machines: expected .*pip install 'distributed>=2024.1'",
        ),
        build._executor_at("tcp://127.0.0.1:8786"),
    ):
        pass
