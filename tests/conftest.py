import gc

import numpy as np
import pytest
from hypothesis import settings

import chromium
import scenes_lod
from v3dg import _device
from v3dg.viewer.frame import SceneView

# A shared machine can stall for longer than any deadline that would still mean
# something.
settings.register_profile("v3dg", deadline=None, print_blob=True)
settings.load_profile("v3dg")


@pytest.fixture(scope="session", params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    """Each device in turn; devices.py brings arrays there and back."""
    return request.param


@pytest.fixture(scope="module")
def browser():
    """Chromium, for tests that ask for playwright and skip without it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium.PROGRAM, args=chromium.ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def blob_bundle():
    """A small bundle, for the viewer's tests."""
    rng = np.random.default_rng(0)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 3000, size=0.5), 64)


@pytest.fixture(scope="session")
def blob_view(blob_bundle):
    """What the viewer draws of it, on the CPU."""
    return SceneView(blob_bundle, device="cpu")


@pytest.fixture(scope="module")
def collected_connections():
    """No connection that a module's tests left to the collector is there in the tests
    after them."""
    yield
    gc.collect()


def pytest_collection_modifyitems(items):
    missing = _device.missing_for_cuda()
    if missing is None:
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason=missing))
