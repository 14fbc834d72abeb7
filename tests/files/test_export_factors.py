"""Exports of scenes whose instances have an opacity or a tint. The command reports what
a format cannot store, and leaves out hidden instances."""

import warnings

import numpy as np
import pytest

import v3dg
from random_bundle import random_bundle
from v3dg.export._common import ExportWarning

BUNDLE = random_bundle(1)


def scene(**factors):
    scene = v3dg.Scene()
    scene.add(BUNDLE, np.eye(3), **factors)
    return scene


def write_usd(scene, folder):
    pytest.importorskip("pxr")
    v3dg.write_usd(scene, folder / "a.usda")
    return v3dg.read_usd_scene(folder / "a.usda", device="cpu")


def write_tiles(scene, folder):
    return range(v3dg.write_tiles(scene, folder / "a").instances)


def write_site(scene, folder):
    return range(v3dg.write_site(scene, folder / "a").instances)


WRITERS = pytest.mark.parametrize("write", [write_usd, write_tiles, write_site])


@WRITERS
def test_left_out_factors_are_told(write, tmp_path):
    with pytest.warns(
        ExportWarning, match="cannot store the opacity and tint.*those of 2 instances are left"
    ):
        write(scene(opacity=[1, 0.5, 1], tint=[(1, 1, 1), (1, 1, 1), (1, 0, 1)]), tmp_path)


@WRITERS
def test_hidden_instances_are_left_out(write, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", ExportWarning)
        assert len(write(scene(opacity=[1, 0, 1]), tmp_path)) == 2


@WRITERS
def test_scenes_without_factors_are_exported_without_a_word(write, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", ExportWarning)
        assert len(write(scene(), tmp_path)) == 3


def test_a_cut_as_an_asset_has_the_factors(tmp_path):
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=64, height=48)
    tinted = v3dg.select(scene(opacity=0.5), camera, tolerance=0, cull=False, device="cpu")
    plain = v3dg.select(scene(), camera, tolerance=0, cull=False, device="cpu")
    half = plain.gaussians(device="cpu").opacities * np.float32(0.5)
    np.testing.assert_array_equal(tinted.gaussians(device="cpu").opacities, half)
