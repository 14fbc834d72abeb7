"""Bundles that stay encoded give the same bits as bundles of the decoded rows."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

import scenes_lod
from devices import host
from frames import Renderer, arrays, render
from random_bundle import random_bundle
from v3dg import Bundle, Gaussians, Scene, _core, _device, select
from v3dg.residency import residency

DEGREES = (0, 1, 2, 3)


@pytest.fixture(autouse=True)
def small_bundles_stay_codes(monkeypatch):
    monkeypatch.setattr("v3dg.residency.MOST_DECODED_BYTES", 0)


def both(bundle):
    """Return the bundle as codes, and as the decoded rows."""
    codes = Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec="quantized")
    return codes, Bundle(codes.clusters, codes.groups, codes.gaussians)


def lod_bundle(seed, sh_degree, num=700, cluster_size=32):
    rng = np.random.default_rng(seed)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, num, sh_degree=sh_degree), cluster_size)


def same_bits(first, second):
    for one, other in zip(arrays(first), arrays(second), strict=True):
        assert one.tobytes() == other.tobytes()
    assert first.stats.gaussians_in_frustum == second.stats.gaussians_in_frustum


def scenes_of(bundles, seed, count=40):
    """Return three scenes with the same instances: of encoded bundles, of decoded
    bundles, and of both alternately."""
    rng = np.random.default_rng(seed)
    pairs = [both(bundle) for bundle in bundles]
    poses = [
        {
            "positions": rng.normal(0, 3, (count, 3)),
            "quaternions": rng.normal(size=(count, 4)),
            "scales": np.exp(rng.normal(0, 0.5, count)),
            "importance": np.exp(rng.normal(0, 0.5, count)),
        }
        for _ in pairs
    ]
    result = []
    for kinds in ((0, 0, 0, 0), (1, 1, 1, 1), (0, 1, 0, 1), (1, 0, 1, 0)):
        scene = Scene()
        for pair, kind, pose in zip(pairs, kinds, poses, strict=False):
            scene.add(pair[kind], **pose)
        result.append(scene)
    return result


@pytest.mark.parametrize("sh_degree", DEGREES)
def test_pictures_have_the_same_bits(device, sh_degree):
    rng = np.random.default_rng(sh_degree)
    codes, rows = both(lod_bundle(sh_degree, sh_degree))
    for distance in (0.3, 2.0, 5.0, 40.0):
        camera = scenes_lod.random_camera(rng, distance=distance, width=97, height=61)
        others = {"budget": 300}, {"min_level": 1}, {"color_by": "cluster"}, {"fade": 4.0}
        for options in ({}, {"tolerance": 30.0}, *others):
            same_bits(*(render(b, camera, device=device, **options) for b in (codes, rows)))


@pytest.mark.parametrize("sh_degree", DEGREES)
def test_scenes_of_either_kind_and_of_both_have_the_same_bits(device, sh_degree):
    rng = np.random.default_rng(sh_degree)
    bundles = [
        lod_bundle(k, degree, 200 + 90 * k, 16) for k, degree in enumerate((sh_degree, 0, 3, 1))
    ]
    all_scenes = scenes_of(bundles, sh_degree)
    for color_by in ("appearance", "level"):
        renderers = [Renderer(scene, color_by=color_by, device=device) for scene in all_scenes]
        for distance in (2.0, 8.0, 300.0):
            camera = scenes_lod.random_camera(rng, distance=distance, width=90, height=70)
            for fade in (None, 1.5):
                first, *others = (
                    renderer.render(camera, tolerance=4.0, fade=fade) for renderer in renderers
                )
                for other in others:
                    same_bits(first, other)


@pytest.mark.parametrize("seed", range(12))
def test_empty_and_tiny_clusters_have_the_same_bits(device, seed):
    rng = np.random.default_rng(seed)
    bundle = random_bundle(seed, num_levels=seed % 5, sh_degree=seed % 4, max_cluster=3 + seed % 3)
    scene_of_codes, scene_of_rows, *_ = scenes_of([bundle], seed, 6)
    camera = scenes_lod.random_camera(rng, distance=4.0)
    for options in ({}, {"tolerance": 100.0}, {"fade": 4.0}):
        cut = select(scene_of_codes, camera, device=device, **options)
        pictures = [
            render(s, camera, device=device, **options) for s in (scene_of_codes, scene_of_rows)
        ]
        same_bits(*pictures)
        drawn = dataclasses.replace(cut, scene=scene_of_rows, revision=scene_of_rows.revision)
        same_bits(
            render(scene_of_codes, camera, cut=cut, device=device),
            render(scene_of_rows, camera, cut=drawn, device=device),
        )


@pytest.mark.parametrize("sh_degree", DEGREES)
def test_selected_gaussians_have_the_same_bits(device, sh_degree):
    bundles = [lod_bundle(k, degree, 300, 16) for k, degree in enumerate((sh_degree, 1))]
    camera = scenes_lod.random_camera(np.random.default_rng(0), distance=6.0)
    first, *others = (
        select(scene, camera, tolerance=4.0, device=device).gaussians((1, 2, 3), device=device)
        for scene in scenes_of(bundles, sh_degree)
    )
    for other in others:
        for name, array in vars(first).items():
            assert host(array).tobytes() == host(getattr(other, name)).tobytes(), name


@pytest.mark.parametrize("sh_degree", DEGREES)
def test_a_model_decodes_clusters_in_any_order(device, sh_degree):
    codes, rows = both(lod_bundle(7, sh_degree))
    ids = np.random.default_rng(1).integers(0, len(codes.clusters), 50).astype(np.int32)
    model = residency.model(codes, _device.resolve(device))
    expected = [rows.cluster_gaussians(int(c)) for c in ids]
    for name, column in vars(Gaussians(*model.decode(ids))).items():
        values = np.concatenate([getattr(part, name) for part in expected])
        assert host(column).tobytes() == values.tobytes(), name
    assert len(model.decode(np.zeros(0, np.int32))[0]) == 0
    with pytest.raises(IndexError, match="cluster_ids: expected ids of at least 0 and below"):
        model.decode(np.array([len(codes.clusters)], np.int32))
    with pytest.raises(ValueError, match="expected quantized gaussians"):
        residency.model(rows, _device.resolve(device)).decode(ids)


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_every_instruction_set_draws_the_same_bits(isa, sh_degree, tmp_path):
    codes, rows = both(lod_bundle(2, sh_degree))
    paths = [tmp_path / "codes.v3dg", tmp_path / "rows.v3dg"]
    codes.write(paths[0])
    rows.write(paths[1])
    program = (
        "import sys, v3dg\n"
        "camera = v3dg.Camera.look_at((0, -3, 1), (0, 0, 0), (0, 0, 1), 0.9, width=97, height=61)\n"
        "images = [v3dg.render(v3dg.Bundle.open(p), camera, device='cpu') for p in sys.argv[1:]]\n"
        "assert images[0].stats.gaussians_in_frustum > 100\n"
        "assert images[0].color.tobytes() == images[1].color.tobytes()\n"
    )
    environment = {
        **os.environ,
        "V3DG_ISA": isa,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    command = [sys.executable, "-c", program, *map(str, paths)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if "this processor does not support" in done.stderr:
        pytest.skip(f"this processor does not support {isa}")
    assert done.returncode == 0, done.stderr


def test_a_bundle_keeps_codes_and_no_rows(tmp_path):
    path = tmp_path / "codes.v3dg"
    codes, rows = both(lod_bundle(0, 3))
    codes.write(path)
    opened = Bundle.open(path)
    render(opened, scenes_lod.random_camera(np.random.default_rng(0)), device="cpu")
    assert opened.codes is opened.codes  # the codes are kept
    assert opened.gaussians is not opened.gaussians  # gaussians are created again
    assert rows.codes is None
    for name, array in vars(opened.gaussians).items():
        assert array.tobytes() == getattr(rows.gaussians, name).tobytes(), name


@pytest.mark.parametrize(("sh_degree", "most"), [(0, 18), (3, 48)])
def test_memory_a_gaussian_stays_below_its_bound(device, sh_degree, most):
    """The clusters have about 170 gaussians, as in builds. The tables count, too."""
    codes, _ = both(lod_bundle(0, sh_degree, 20_000, 256))
    where = _device.resolve(device)
    render(codes, scenes_lod.random_camera(np.random.default_rng(0)), device=device).stats  # noqa: B018
    model, table = residency.model(codes, where), residency.table(codes)
    assert (model.bytes + table.bytes_on(where.number)) / codes.num_gaussians <= most


@pytest.mark.gpu
@pytest.mark.parametrize("num_decoded", [0, 1, 2])
def test_small_bundles_are_decoded_once_while_they_fit(monkeypatch, num_decoded):
    where = _device.resolve("cuda")
    pairs = [both(lod_bundle(seed, 1)) for seed in (3, 3, 3)]
    row_bytes = residency.model(pairs[0][1], where).bytes
    taken = sum(entries.get(("decoded", where), 0) for entries in residency._entries.values())
    monkeypatch.setattr(
        "v3dg.residency.MOST_DECODED_BYTES", taken + int((num_decoded + 0.5) * row_bytes)
    )
    camera = scenes_lod.random_camera(np.random.default_rng(0))
    for k, (codes, rows) in enumerate(pairs):
        same_bits(*(render(b, camera, device="cuda") for b in (codes, rows)))
        is_decoded = residency.model(codes, where).bytes == row_bytes
        assert is_decoded == (k < num_decoded)
        cut = select(codes, camera, device="cuda")
        for name, array in vars(cut.gaussians()).items():
            expected = getattr(select(rows, camera, device="cuda").gaussians(), name)
            assert host(array).tobytes() == host(expected).tobytes(), name


def test_pages_that_are_none_are_refused():
    codes, _ = both(lod_bundle(0, 1, 100))
    page = _core.encode_page(codes.gaussians.rows, codes.clusters.offset)
    one, offset = np.array([0, len(codes.clusters)]), codes.clusters.offset
    assert _core.Codes(page, one, offset, 1)
    for arguments in (
        (page[:-4].copy(), one, offset, 1),
        (page, one[:1], offset, 1),
        (page, one, offset, 2),
        (page, one + 1, offset, 1),
        (page, one, offset + 1, 1),
        (page, one[::-1].copy(), offset, 1),
        (page, one, offset, 4),
    ):
        with pytest.raises(ValueError, match="expected"):
            _core.Codes(*arguments)
    broken = page.copy()
    broken.view(np.float32)[6 * codes.num_gaussians] = np.nan  # the first mean of the first cluster
    with pytest.raises(ValueError, match="cluster 0: expected finite ranges"):
        _core.Codes(broken, one, offset, 1)
