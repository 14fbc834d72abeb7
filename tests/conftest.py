import pytest
from hypothesis import settings

from v3dg import _core

# A shared machine can stall for longer than any deadline that would still mean something.
settings.register_profile("v3dg", deadline=None, print_blob=True)
settings.load_profile("v3dg")


def pytest_collection_modifyitems(items):
    if _core.num_cuda_devices() > 0:
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="no CUDA device, or built without CUDA"))
