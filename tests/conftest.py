"""Fixtures and settings of all tests: both devices, Chromium, and a small bundle for
the viewer.

Each test is in the folder of its kind:

    unit     one module or operation in this process; files have the names of modules
    files    file formats and places of files: reading, writing, and refused files
    system   whole commands, servers, pools, threads and builds
    browser  pages in Chromium
    attack   hostile input, and programs that are stopped at any moment
    docs     the source tree, the types and the pages are correct

Tests in `system`, `browser` and `attack` are marked slow, and so are tests elsewhere
that take more than a few seconds. `pytest -m "not slow"` leaves them out.
"""

import gc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

import chromium
import scenes_lod
from v3dg import _device
from v3dg.viewer.frame import SceneView

# A shared machine can stall for longer than any useful deadline.
settings.register_profile("v3dg", deadline=None, print_blob=True)
settings.load_profile("v3dg")


@pytest.fixture(scope="session", params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    """The device, which is each device in turn. devices.py has functions that copy
    arrays to it and back."""
    return request.param


@pytest.fixture(scope="module")
def browser():
    """Chromium, for tests that use playwright. They are skipped if it is missing."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium.PROGRAM, args=chromium.ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def blob_bundle():
    """A small bundle for the tests of the viewer."""
    rng = np.random.default_rng(0)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 3000, size=0.5), 64)


@pytest.fixture(scope="session")
def blob_view(blob_bundle):
    """The part of the viewer that draws this bundle, on the CPU."""
    return SceneView(blob_bundle, device="cpu")


@pytest.fixture(scope="module")
def collected_connections():
    """Collects garbage after each module, so that connections that its tests left open
    do not reach the tests of the next module."""
    yield
    gc.collect()


TESTS = Path(__file__).parent
SLOW_KINDS = {"system", "browser", "attack"}


def pytest_collection_modifyitems(items):
    for item in items:
        kind = item.path.relative_to(TESTS).parts[0]
        item.add_marker(kind)
        if kind in SLOW_KINDS:
            item.add_marker("slow")
    missing = _device.missing_for_cuda()
    if missing is None:
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason=missing))
