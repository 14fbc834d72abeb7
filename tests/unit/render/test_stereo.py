"""Two eyes share one cut. It is exact for the nearer eye, and omits what neither eye
can see."""

import dataclasses
import pickle

import numpy as np
import pytest

from frames import Renderer, arrays, render
from scenes_lod import blob, lod_bundle
from v3dg import Camera, Scene, StereoCamera, select
from v3dg.residency import residency


@pytest.fixture(scope="module")
def scene():
    rng, scene = np.random.default_rng(0), Scene()
    for degree in (0, 2):
        bundle = lod_bundle(rng, blob(rng, 900, sh_degree=degree), 24)
        count = 12
        scene.add(
            bundle,
            positions=rng.normal(0, 4, (count, 3)),
            quaternions=rng.normal(size=(count, 4)),
            scales=np.exp(rng.normal(0, 0.5, count)),
            importance=np.exp(rng.normal(0, 0.5, count)),
        )
    return scene


def stereo_cameras(count=20, seed=1):
    """Return cameras near and far, with small and large eye distances, and different
    fields of view and sizes."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        eye = rng.normal(size=3) * rng.choice([1.0, 6.0, 20.0])
        middle = Camera.look_at(eye, rng.normal(size=3), (0, 0, 1), 0.9, width=93, height=61)
        stereo = StereoCamera.of(middle, float(rng.choice([0.06, 1.0, 8.0])))
        K = stereo.right.K * rng.uniform(0.7, 1.4) + np.diag([0, 0, 0.0])
        K[:, 2] = [*(rng.uniform(0.3, 0.7, 2) * [81, 67]), 1]
        right = dataclasses.replace(
            stereo.right, K=K, width=81, height=67, near=float(rng.uniform(0.01, 0.5))
        )
        yield stereo
        yield StereoCamera(stereo.left, right)


def options_of(k, scene, stereo):
    least = select(scene, stereo, tolerance=np.inf, device="cpu").num_gaussians
    most = select(scene, stereo, tolerance=0.0, device="cpu").num_gaussians
    return [
        {"tolerance": 4.0},
        {"tolerance": 1.0, "fade": 1.3},
        {"budget": (least + most) // 2},
        {"tolerance": 0.5, "min_level": 1},
    ][k % 4]


def test_the_cut_is_that_of_the_nearer_eye(scene):
    """The cut is refined wherever it is refined for one of the eyes alone. On every
    path, the cut of each eye is at least as coarse."""
    groups_of = [bundle.clusters for bundle in scene.bundles]
    for stereo in stereo_cameras():
        if stereo.left.fx != stereo.right.fx:
            continue  # otherwise the larger pixels of one eye would be used for both
        level = {"tolerance": 3.0, "cull": False, "device": "cpu"}
        both, left, right = (select(scene, camera, **level) for camera in (stereo, *stereo.eyes))
        for i in range(len(scene)):
            clusters = groups_of[scene.instance_bundle[i]]
            refined = [refined_groups(cut, i, clusters) for cut in (both, left, right)]
            assert refined[0] == refined[1] | refined[2]


def refined_groups(cut, i, clusters):
    """Return the groups above the chosen clusters of an instance."""
    parent_of_group = np.full(clusters.parent_group.max() + 1, -1)
    made = clusters.own_group >= 0
    parent_of_group[clusters.own_group[made]] = clusters.parent_group[made]
    refined = set()
    for c in cut.cluster_ids[cut.instance_ids == i]:
        g = clusters.parent_group[c]
        while g >= 0 and g not in refined:
            refined.add(int(g))
            g = parent_of_group[g]
    return refined


def test_nothing_that_an_eye_sees_is_left_out(scene, device):
    for k, stereo in enumerate(stereo_cameras()):
        options = options_of(k, scene, stereo)
        cut = select(scene, stereo, device=device, **options)
        pictures = render(scene, stereo, device=device, **options)
        whole = {**options, "tolerance": cut.tolerance}
        whole.pop("budget", None)
        whole_cut = select(scene, stereo, cull=False, device=device, **whole)
        assert set(pairs(cut)) <= set(pairs(whole_cut))
        for eye, picture in zip(stereo.eyes, pictures, strict=True):
            for one in (cut, whole_cut):
                same_picture(picture, render(scene, eye, cut=one, device=device))
        assert (
            pictures[0].stats.gaussians_selected
            == cut.num_gaussians
            == pictures[1].stats.gaussians_selected
        )
        assert pictures[0].stats.tolerance == cut.tolerance


def pairs(cut):
    return zip(cut.instance_ids.tolist(), cut.cluster_ids.tolist(), strict=True)


def same_picture(picture, other):
    for one, wanted in zip(arrays(picture), arrays(other), strict=True):
        np.testing.assert_array_equal(one, wanted)


def test_equal_eyes_are_one_camera(scene, device):
    camera = next(stereo_cameras()).left
    for left in render(scene, StereoCamera(camera, camera), tolerance=2.0, device=device):
        same_picture(left, render(scene, camera, tolerance=2.0, device=device))


def test_a_budget_holds_for_both(scene, device):
    stereo = next(stereo_cameras(seed=5))
    least = select(scene, stereo, tolerance=np.inf, device=device).num_gaussians
    left, _ = render(scene, stereo, budget=least + 500, device=device)
    assert left.stats.gaussians_selected <= least + 500
    with pytest.raises(ValueError, match="budget"):
        render(scene, stereo, budget=1, device=device)[1].color  # noqa: B018


def test_both_eyes_are_settled(scene, device):
    stereo = next(stereo_cameras(seed=7))
    pictures = render(scene, stereo, tolerance=1.0, device=device, memory="64MB")
    for picture, other in zip(
        pictures, render(scene, stereo, tolerance=1.0, device=device), strict=True
    ):
        assert picture.stats.missing == 0
        same_picture(picture, other)


def test_assets_are_drawn_for_each_eye(scene, device):
    stereo, asset = next(stereo_cameras()), scene.bundles[0].gaussians
    for picture, eye in zip(render(asset, stereo, device=device), stereo.eyes, strict=True):
        same_picture(picture, render(asset, eye, device=device))


@pytest.mark.gpu
def test_both_devices_choose_the_same(scene):
    for k, stereo in enumerate(stereo_cameras()):
        options = options_of(k, scene, stereo)
        cpu, cuda = (select(scene, stereo, device=device, **options) for device in ("cpu", "cuda"))
        np.testing.assert_array_equal(cpu.instance_ids, cuda.instance_ids)
        np.testing.assert_array_equal(cpu.cluster_ids, cuda.cluster_ids)
        np.testing.assert_array_equal(cpu.weights, cuda.weights)


@pytest.mark.gpu
def test_frames_that_are_too_small_are_drawn_again(scene):
    stereo = next(stereo_cameras())
    first = Renderer(scene, device="cuda").render(stereo, tolerance=0.0)
    residency.clear()
    for picture, other in zip(
        first, render(scene, stereo, tolerance=0.0, device="cuda"), strict=True
    ):
        same_picture(picture, other)


def test_what_is_no_stereo_camera_is_refused(scene):
    camera = Camera.look_at((0, -9, 1), (0, 0, 0), width=32, height=24)
    turned = Camera.look_at((0.1, -9, 1), (0, 0, 0), width=32, height=24)
    with pytest.raises(ValueError, match="right: expected a camera of the same rotation"):
        StereoCamera(camera, turned)
    with pytest.raises(ValueError, match="eye_distance"):
        StereoCamera.of(camera, 0.0)
    stereo = StereoCamera.of(camera, 0.1)
    with pytest.raises(ValueError, match="footprint: expected 'solid_angle' for two eyes"):
        select(scene, stereo, footprint="paper", device="cpu")
    again = pickle.loads(pickle.dumps(stereo))
    assert np.array_equal(again.right.viewmat, stereo.right.viewmat)
    np.testing.assert_allclose(
        stereo.right.position - stereo.left.position, [0.1, 0, 0], atol=1e-12
    )
