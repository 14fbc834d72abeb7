"""A program that ends.py starts. Its threads are at work while it ends in one of
several ways.

ending_program.py WORK ENDING NUM_THREADS SECONDS GAP

The program prints the time at which it begins to end, in seconds of the monotonic
clock. It works in the current folder, which has a.ply and a.v3dg.
"""

import atexit
import contextlib
import itertools
import os
import signal
import sys
import threading
import time

if __name__ == "__main__":
    # Handlers run in reverse order, so this one runs after all handlers of the package.
    atexit.register(lambda: draw_last())

import numpy as np

import v3dg

CAMERAS = [
    v3dg.Camera.look_at((9 * np.cos(k), 9 * np.sin(k), 2), (0, 0, 0), width=120, height=90)
    for k in range(16)
]
QUICK = v3dg.BuildConfig(steps=1, num_views=2, cluster_size=64)
MEMORY = 64 << 10


def draw_last():
    """Draw in the last exit handler."""
    if sys.argv[2] == "last handler renders":
        v3dg.render(v3dg.Bundle.open("a.v3dg"), CAMERAS[0], device="cpu")


def render():
    bundle = v3dg.Bundle.open("a.v3dg")
    for camera in itertools.cycle(CAMERAS):
        yield v3dg.render(bundle, camera, device="cpu", memory=None)


def select():
    bundle = v3dg.Bundle.open("a.v3dg")
    for camera in itertools.cycle(CAMERAS):
        yield v3dg.select(bundle, camera, device="cpu")


def rasterize():
    asset = v3dg.read_asset("a.ply")
    for camera in itertools.cycle(CAMERAS):
        yield v3dg.rasterize(asset, camera)


def open_files():
    for path in itertools.cycle(("a.ply", "a.v3dg")):
        yield v3dg.open(path)


def write():
    asset = v3dg.read_asset("a.ply")
    for suffix in itertools.cycle(("ply", "spz")):
        path = f"{threading.get_ident()}.{suffix}"
        yield v3dg.write_asset(path, asset)


def build():
    asset = v3dg.read_asset("a.ply")
    while True:
        yield v3dg.build_bundle(asset, config=QUICK, device="cpu", progress=False)


def pool():
    bundle = v3dg.Bundle.open("a.v3dg")
    for camera in itertools.cycle(CAMERAS):
        yield v3dg.render(bundle, camera, device="cpu", memory=MEMORY)


def pools_of_renderers():
    for k in itertools.count():
        renderer = v3dg.Renderer("a.v3dg", device="cpu", memory=MEMORY)
        for camera in CAMERAS[k % 8 :: 3]:
            yield renderer.render(camera)


def pool_of_url():
    """Threads of a pool, which Python did not start, call functions of Python."""
    for k in itertools.count():
        renderer = v3dg.Renderer(v3dg.open("memory://in/a.v3dg"), device="cpu", memory=MEMORY)
        for camera in CAMERAS[k % 8 :: 3]:
            yield renderer.render(camera)


def pick():
    bundle = v3dg.Bundle.open("a.v3dg")
    for camera in itertools.cycle(CAMERAS):
        yield v3dg.pick(bundle, camera, 60, 45)


def viewer():
    """A tab of a viewer draws one picture after another."""
    from dataclasses import replace

    from v3dg.viewer.server import start_view
    from viewer_client import Tab

    site = v3dg.view("a.v3dg", port=0, device="cpu")
    kept.append(site)
    home = start_view(site._scene_view, (0, 0, 1))
    with Tab(site.port) as tab:
        for k in itertools.count():
            yield tab.look(replace(home, position=(9.0, 0.1 * (k % 30), 2.0)), (400, 300))
            tab.pictures(until=time.perf_counter() + 0.02)


WORK = {
    "render": render,
    "select": select,
    "rasterize": rasterize,
    "open": open_files,
    "write": write,
    "build": build,
    "pool": pool,
    "pools of renderers": pools_of_renderers,
    "pool of a URL": pool_of_url,
    "pick": pick,
    "viewer": viewer,
}
kept = []


def go_on(name, has_begun=None):
    # Once the interpreter ends, nothing can be loaded any more.
    with contextlib.suppress(ImportError):
        for done in WORK[name]():
            kept[1:] = [done]
            if has_begun is not None:
                has_begun.release()


def started(name, count):
    """Return threads at work, once each of them has finished something."""
    has_begun = threading.Semaphore(0)
    for _ in range(count):
        threading.Thread(target=go_on, args=(name, has_begun), daemon=True).start()
    for _ in range(count):
        has_begun.acquire()


def interrupt_twice(gap):
    def send():
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(gap)

    threading.Thread(target=send, daemon=True).start()
    time.sleep(60)


def render_once():
    v3dg.render(v3dg.Bundle.open("a.v3dg"), CAMERAS[0], device="cpu", memory=MEMORY)


def end(how, work, gap):
    """End the program in one of the ways.

    If this function returns, the main module ends next.
    """
    if how == "handler renders":
        atexit.register(render_once)
    if how == "handler starts threads":

        def start():
            # Since Python 3.12, no thread can be started then.
            with contextlib.suppress(RuntimeError):
                threading.Thread(target=go_on, args=(work,), daemon=True).start()
                time.sleep(gap)

        atexit.register(start)
    if how == "SIGINT twice":
        interrupt_twice(gap)
    if how == "SIGTERM":
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    if how == "SIGTERM exits":
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(3))
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    if how == "sys.exit":
        sys.exit(3)
    if how == "exception":
        raise ArithmeticError
    if how == "thread that is waited for":
        threading.Thread(target=time.sleep, args=(gap,)).start()


def main():
    work, how, num_threads, seconds, gap = sys.argv[1:]
    if work == "pool of a URL":
        import fsspec

        with open("a.v3dg", "rb") as file, fsspec.open("memory://in/a.v3dg", "wb") as copy:
            copy.write(file.read())
    started(work, int(num_threads))
    time.sleep(float(seconds))
    print(f"ends {time.monotonic()}", flush=True)
    end(how, work, float(gap))


if __name__ == "__main__":
    main()
