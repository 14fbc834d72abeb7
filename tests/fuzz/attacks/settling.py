"""Views settle in pools while the machine is busy. The next picture must miss no page
and have the right bits.

Pictures are compared bit for bit with those of the same scene with all pages resident,
drawn at the tolerance that the picture reports. Between settled pictures, other
pictures are drawn without waiting, so that pages for earlier views arrive and leave,
and tolerances adapt, while a view settles. The environment variable V3DG_ATTACK_DEVICE
selects a device other than the CPU.
"""

import contextlib
import hashlib
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import v3dg
from devices import host
from fuzz.attacks.pool import Outcome
from scenes_lod import blob, lod_bundle

LIMIT_S = 240
DEVICE = os.environ.get("V3DG_ATTACK_DEVICE", "cpu")
NUM_CAMERAS = 12
NUM_SETTLED = 250
NUM_STILLS = 48
CUTS = (
    {"tolerance": 0.5},
    {"tolerance": 3.0},
    {"tolerance": 0.5, "fade": 1.05},
    {"tolerance": 0.2, "min_level": 1},
)


def prepare(shared):
    for codec in ("float32", "quantized"):
        rng = np.random.default_rng(0)
        bundle = lod_bundle(rng, blob(rng, 4000, sh_degree=1), 32)
        v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec=codec).write(
            Path(shared) / f"{codec}.v3dg"
        )


class Attack:
    def __init__(self, shared):
        self._scenes = {}
        for codec in ("float32", "quantized"):
            rng = np.random.default_rng(1)
            scene = v3dg.Scene()
            poses = {
                "positions": 2 * rng.normal(size=(3, 3)),
                "quaternions": rng.normal(size=(3, 4)),
            }
            scene.add(v3dg.Bundle.open(Path(shared) / f"{codec}.v3dg"), **poses)
            self._scenes[codec] = scene
        self._expected = Expected()

    def plan(self, rng, work):
        story = rng.choice(STORIES)
        seed = rng.getrandbits(32)
        codec = rng.choice(sorted(self._scenes))

        def do():
            trial = Trial(self._scenes[codec], codec, np.random.default_rng(seed), self._expected)
            with busy_threads(trial.rng.integers(0, 3)):
                fault = story(trial)
            return Outcome("fault" if fault else "right", fault)

        return f"{story.__name__}, {codec}", do


class Expected:
    """The digests of pictures of scenes that are completely resident."""

    def __init__(self):
        self._renderers = {}
        self._digests = {}
        self._lock = threading.Lock()

    def digest(self, scene, name, number, camera, cut, tolerance):
        key = (name, number, tuple(cut.items()), tolerance)
        with self._lock:
            if key not in self._digests:
                if name not in self._renderers:
                    self._renderers[name] = v3dg.Renderer(scene, device=DEVICE, memory=None)
                image = self._renderers[name].render(camera, **cut | {"tolerance": tolerance})
                self._digests[key] = digest(image)
            return self._digests[key]


class Trial:
    """A scene, the pool that is tested with it, and views of it."""

    def __init__(self, scene, name, rng, expected):
        self.scene = scene
        self.name = name
        self.rng = rng
        self.cut = CUTS[int(rng.integers(len(CUTS)))]
        # A view with one of the finer cuts takes about 400 kB of rows, or 120 kB of
        # codes.
        full = 400_000 if name == "float32" else 120_000
        self.memory = int(full * rng.choice([0.5, 0.75, 1.0, 2.0, 4.0, 100.0]))
        self._expected = expected

    def camera(self, number):
        rng = np.random.default_rng(number)
        return v3dg.Camera.look_at(
            4 * rng.normal(size=3), rng.normal(size=3), (0, 0, 1), width=40, height=32
        )

    def fault_of(self, number, image):
        """Return the fault of the picture of a settled view, or None."""
        stats = image.stats
        if stats.missing:
            return f"a settled picture misses {stats.missing} pages"
        expected = self._expected.digest(
            self.scene, self.name, number, self.camera(number), self.cut, stats.tolerance
        )
        if digest(image) != expected:
            return "a settled picture has other bits"
        if self.memory > 10_000_000 and abs(stats.tolerance - self.cut["tolerance"]) > 1e-6:
            return f"the tolerance was raised to {stats.tolerance} in a roomy pool"
        return None


def digest(image):
    planes = host((image.color, image.alpha))
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
    ).hexdigest()


@contextlib.contextmanager
def busy_threads(count):
    """Run other threads that keep the machine busy, for intervals of different
    lengths."""
    ends = threading.Event()

    def work():
        rng = np.random.default_rng()
        values = np.ones(200_000)
        while not ends.is_set():
            np.sqrt(values, out=values)
            if rng.random() < 0.2:
                time.sleep(0.001)

    threads = [threading.Thread(target=work, daemon=True) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ends.set()
        for thread in threads:
            thread.join()


def after_settling(trial):
    """Draw immediately after each `settle` of a flight. Other pictures are drawn in
    between without waiting."""
    renderer = v3dg.Renderer(trial.scene, device=DEVICE, memory=trial.memory)
    for _ in range(NUM_SETTLED):
        for number in trial.rng.integers(0, NUM_CAMERAS, int(trial.rng.integers(0, 3))):
            cut = CUTS[int(trial.rng.integers(len(CUTS)))]
            renderer.render(trial.camera(int(number)), **cut)
        number = int(trial.rng.integers(0, NUM_CAMERAS))
        renderer.settle(trial.camera(number), **trial.cut)
        image = renderer.render(trial.camera(number), **trial.cut)
        if fault := trial.fault_of(number, image):
            return fault
    return None


def stills_of_threads(trial):
    """Call `v3dg.render` with the same `memory` from two to eight threads."""
    faults = []

    def draw(numbers):
        for number in numbers:
            if faults:
                return
            image = v3dg.render(
                trial.scene, trial.camera(number), device=DEVICE, memory=trial.memory, **trial.cut
            )
            if fault := trial.fault_of(number, image):
                faults.append(fault)

    num_threads = int(trial.rng.integers(2, 9))
    numbers = [int(number) for number in trial.rng.integers(0, NUM_CAMERAS, NUM_STILLS)]
    in_threads(
        [lambda mine=numbers[t::num_threads]: draw(mine) for t in range(num_threads)], faults
    )
    return faults[0] if faults else None


def forks(trial):
    """Fork a process whose threads draw. Its children must draw correctly if they may
    use an object, and otherwise get a clear error."""
    faults = []
    ends = threading.Event()
    renderer = v3dg.Renderer(trial.scene, device=DEVICE, memory=trial.memory)
    number = int(trial.rng.integers(0, NUM_CAMERAS))
    camera = trial.camera(number)
    renderer.render(camera, **trial.cut)

    def draw(make):
        while not ends.is_set():
            make()

    def still():
        v3dg.render(trial.scene, camera, device=DEVICE, memory=trial.memory, **trial.cut)

    pictures = [lambda: draw(still), lambda: draw(lambda: renderer.render(camera, **trial.cut))]
    threads = [threading.Thread(target=picture, daemon=True) for picture in pictures]
    for thread in threads:
        thread.start()
    try:
        for _ in range(4):
            time.sleep(float(trial.rng.uniform(0, 0.05)))
            if fault := fault_of_child(lambda: in_child(trial, renderer, number)):
                faults.append(fault)
                break
    finally:
        ends.set()
        for thread in threads:
            thread.join()
    return faults[0] if faults else None


def in_child(trial, renderer, number):
    """Return the fault that a forked child finds, or None."""
    camera = trial.camera(number)
    image = v3dg.render(trial.scene, camera, device=DEVICE, memory=trial.memory, **trial.cut)
    if fault := trial.fault_of(number, image):
        return f"in a child, {fault}"
    for use in (
        lambda: v3dg.pick(trial.scene, camera, 3, 3, renderer=renderer),
        lambda: renderer.settle(camera, **trial.cut),
        lambda: renderer.render(camera, **trial.cut),
    ):
        try:
            use()
        except RuntimeError as error:
            if "fork" in str(error):
                continue
        return "in a child, a renderer of the parent was not refused"
    return None


def fault_of_child(work):
    """Return the result of work() in a forked child. It is a fault if the child does
    not end."""
    with tempfile.TemporaryFile() as report:
        pid = os.fork()
        if pid == 0:
            code = 3
            try:
                found = work()
                report.write((found or "").encode())
                report.flush()
                code = 0
            except BaseException as error:
                report.write(f"in a child, {type(error).__name__}: {error}".encode())
                report.flush()
            finally:
                os._exit(code)
        end = time.monotonic() + 60
        while time.monotonic() < end:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                report.seek(0)
                found = report.read().decode()
                return found or (None if status == 0 else f"a child ended with {status}")
            time.sleep(0.002)
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        return "a child does not end"


def in_threads(works, faults):
    def safely(work):
        try:
            work()
        except Exception as error:
            faults.append(f"{type(error).__name__}: {str(error)[:200]!a}")

    threads = [threading.Thread(target=safely, args=(work,), daemon=True) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


STORIES = [after_settling, after_settling, after_settling, stills_of_threads, stills_of_threads]
if DEVICE == "cpu":  # CUDA cannot be used in forked children.
    STORIES.append(forks)
