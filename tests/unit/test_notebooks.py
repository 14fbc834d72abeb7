"""The representations of pictures and bundles in notebooks."""

import io

import numpy as np
import pytest
from PIL import Image

import v3dg
from random_bundle import random_bundle


@pytest.fixture
def bundle():
    return random_bundle(0)


def test_pictures_show_themselves_in_notebooks(bundle):
    camera = v3dg.turntable((0, 0, 0), 4, 1, width=48, height=32)[0]
    drawn = v3dg.rasterize(bundle.level_gaussians(0), camera)
    for picture in (v3dg.render(bundle, camera, device="cpu"), drawn):
        shown = np.asarray(Image.open(io.BytesIO(picture._repr_png_())))
        np.testing.assert_array_equal(shown, v3dg.pictures.to_8bit(picture.color))


def test_bundles_show_their_levels_in_notebooks(bundle):
    shown = bundle._repr_html_()
    assert shown.count("<tr>") == 1 + bundle.num_levels
    for level in bundle.info()["levels"]:
        assert (
            f"<td>{level['level']}<td>{level['clusters']:,}<td>{level['gaussians']:,}<td>" in shown
        )
