"""Tests the comparison with other rasterizers on the CPU.

Scripts replace the other rasterizers.
"""

import json
from dataclasses import fields

import numpy as np
import pytest

import v3dg
from benchmarks.studies.peers import draw as peers_draw
from benchmarks.studies.peers import measure as peers
from benchmarks.studies.peers import report as peers_report
from benchmarks.studies.peers import scenes as peers_scenes
from benchmarks.worlds.procedural import make_person
from reference import project

torch = pytest.importorskip("torch")

# This script draws with our own rasterizer, but takes the options of gsplat.
GSPLAT = """
import torch, v3dg

def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, *,
                  near_plane, eps2d, sh_degree, packed):
    sh = colors if sh_degree is not None else (colors[:, None] - 0.5) / v3dg._core.sh_base0
    camera = v3dg.Camera(viewmats[0].numpy(), Ks[0].numpy(), width, height, near_plane)
    gaussians = v3dg.Gaussians(means, quats, scales, opacities, sh)
    image = v3dg.rasterize(gaussians, camera, filter_px2=eps2d)
    return image.color[None], image.alpha[None, ..., None], {}
"""
# This script draws a picture that is wrong by a tenth everywhere.
FASTER_GS = """
from collections import namedtuple
import torch

names = "w2c position background bases width height fx fy cx cy near far antialiasing"
RasterizerSettings = namedtuple("RasterizerSettings", names)

def rasterize(means, scales, rotations, opacities, sh_0, sh_rest, settings, to_chw):
    return torch.full((settings.height, settings.width, 3), 0.1)

def diff_rasterize(means, scales, rotations, opacities, sh_0, sh_rest, densification, settings):
    total = sum(t.sum() for t in (means, scales, rotations, opacities, sh_0, sh_rest))
    return total.expand(3, settings.height, settings.width)
"""
CRASHES = "import os\nos._exit(7)\n"


CAMERA = [[1, 0, 0, 0], [0, 0, 1, -4], [0, -1, 0, 0.5], [0, 0, 0, 1]]
LAYOUT = {
    "name": "two",
    "asset": "thing",
    "convention": "camera to world",
    "instances": [
        {"scale": 0.5, "quaternion": [1, 0, 0, 0], "position": [-0.5, 0, 0]},
        {"scale": 1, "quaternion": [0.8, 0.6, 0, 0], "position": [0.5, 0, 0]},
    ],
    "cameras": [
        {
            "name": "a",
            "width": 96,
            "height": 54,
            "fov_x": 0.8,
            "fov_y": 0.467,
            "transform_matrix": CAMERA,
        }
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An object and two copies of it. There are three rasterizers: one draws correctly,
    one draws wrongly, and one crashes."""
    folder = tmp_path_factory.mktemp("peers")
    files = {
        "layout.json": json.dumps(LAYOUT),
        "assets.json": json.dumps({"thing": {"file": "thing.ply", "up": [0, 0, 1]}}),
        "gsplat/gsplat/__init__.py": GSPLAT,
        "gsplat/VERSION": "1.5.3, a stand-in\n",
        "fastergs_0.3/FasterGSCudaBackend/__init__.py": "",
        "fastergs_0.3/FasterGSCudaBackend/torch_bindings/__init__.py": "",
        "fastergs_0.3/FasterGSCudaBackend/torch_bindings/rasterization.py": FASTER_GS,
        "flashgs_0/flash_gaussian_splatting.py": CRASHES,
        "flashgs_0.3/flash_gaussian_splatting.py": "raise ImportError('no such kernel')",
    }
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    v3dg.write_asset(folder / "thing.ply", make_person(2000, seed=3, sh_degree=0))
    return folder


@pytest.fixture(scope="module")
def found(folder):
    """Return the results of one run over small scenes."""
    peers.main(
        peers.Config(
            asset=folder / "thing.ply",
            layout=folder / "layout.json",
            cameras=(0,),
            captured=folder,
            names=("thing",),
            counts=(300,),
            sh_degree=1,
            widths=(96, 192),
            modules=folder,
            jobs=("v3dg", "gsplat", "fastergs_0.3", "flashgs_0", "flashgs_0.3"),
            seconds=0.0,
            window=16,
            device="cpu",
            output=folder / "peers.json",
        )
    )
    return json.loads((folder / "peers.json").read_text())


def frames(found, renderer):
    return [row for row in found["frame"] if row["renderer"] == renderer]


def test_every_view_is_drawn_with_every_filter_by_everyone(found):
    views = {("layout", "a", 96, 0.0), ("layout", "a", 192, 0.0)}
    for scene, names in {
        "thing": ("eye level", "from above"),
        "random 0.0003 M": ("front",),
    }.items():
        for name in names:
            views |= {(scene, name, 96, 0.3), (scene, name, 192, 0.3), (scene, name, 96, 0.0)}
    for renderer in ("v3dg.Renderer", "v3dg.rasterize", "gsplat packed", "gsplat"):
        rows = frames(found, renderer)
        keys = [(row["scene"], row["view"], row["width"], row["filter_px2"]) for row in rows]
        assert sorted(keys) == sorted(views)
        assert all(
            row["repeats"] == 7 and 0 < row["least_ms"] <= row["ms"] <= row["p95_ms"]
            for row in rows
        )
    assert {row["filter_px2"] for row in frames(found, "Faster-GS")} == {0.3}


def test_errors_are_those_of_the_pictures(found):
    least = {
        "v3dg.Renderer": 70,
        "v3dg.Renderer, 1e-4": 85,
        "v3dg.rasterize": 90,
        "gsplat packed": 90,
        "gsplat": 90,
    }
    for renderer, psnr in least.items():
        assert min(row["psnr"] for row in frames(found, renderer)) > psnr
    wrong = frames(found, "Faster-GS")
    assert wrong
    assert max(row["psnr"] for row in wrong) < 30
    assert all(row["largest_error"] >= row["mean_error"] > 0.01 for row in wrong)


def test_training_is_measured_and_its_gradients_compared(found):
    trained = {(row["renderer"], row["scene"]) for row in found["training"]}
    renderers = ("v3dg.rasterize", "gsplat packed", "gsplat", "Faster-GS")
    assert trained == {
        (name, scene) for name in renderers for scene in ("thing", "random 0.0003 M")
    }
    errors = {row["renderer"]: row["relative_l2"] for row in found["gradients"]}
    for name in ("v3dg.rasterize", "gsplat packed", "gsplat"):
        assert 0 < max(errors[name].values()) < 1e-3
    assert min(errors["Faster-GS"].values()) > 0.1


def test_what_fails_is_said_and_leaves_the_others_alone(found):
    said = {row["job"]: row["error"] for row in found["failure"]}
    assert said == {
        "flashgs_0": "the process ended with 7",
        "flashgs_0.3": "ImportError: no such kernel",
    }
    assert found["versions"] == {"gsplat": "1.5.3, a stand-in"}


def test_page_says_who_is_quickest_and_what_failed(folder, found):
    peers_report.main(peers_report.Report((folder / "peers.json",), folder / "peers.md"))
    page = (folder / "peers.md").read_text()
    row = next(row for row in frames(found, "Faster-GS") if row["scene"] == "thing")
    everyone = [
        r
        for r in found["frame"]
        if all(r[k] == row[k] for k in ("scene", "view", "width", "filter_px2"))
    ]
    ms = {
        "v3dg": min(
            r["ms"] for r in everyone if r["renderer"] in ("v3dg.Renderer", "v3dg.rasterize")
        ),
        "v3dg, 1e-4": next(r["ms"] for r in everyone if r["renderer"] == "v3dg.Renderer, 1e-4"),
        "gsplat": min(r["ms"] for r in everyone if r["renderer"].startswith("gsplat")),
        "Faster-GS": row["ms"],
    }
    cells = [
        *(f"{value:.3f}" for value in ms.values()),
        f"{ms['v3dg'] / min(ms['gsplat'], row['ms']):.2f}",
    ]
    assert f"| {' | '.join(['scene', 'view', 'px', 'filter', *ms, 'ours / fastest'])} |" in page
    assert f"| thing | eye level | 96 | 0.3 | {' | '.join(cells)} |" in page
    assert "- flashgs_0.3: ImportError: no such kernel" in page


def test_unknown_jobs_are_refused():
    with pytest.raises(SystemExit, match=r"jobs: expected some of v3dg, gsplat, .*, got splat"):
        peers.main(peers.Config(jobs=("splat",)))


@pytest.mark.parametrize("filter_px2", [0.0, 0.3])
def test_truths_are_windows_of_the_whole_picture(filter_px2):
    subject = peers_scenes.random(3000, 2, "cpu")
    camera = peers_scenes.at_size(subject.cameras["front"], 480, 270)
    doubles = v3dg.Gaussians(
        *(getattr(subject.gaussians, f.name).double() for f in fields(subject.gaussians))
    )
    whole = v3dg.rasterize(doubles, camera, filter_px2=filter_px2).color.numpy()
    boxes = peers_scenes.windows(camera, 32)
    assert len(set(boxes)) == 8
    for truth, (x0, y0, x1, y1) in zip(
        peers_scenes.truths(subject, camera, filter_px2, 32), boxes, strict=True
    ):
        np.testing.assert_array_equal(truth, whole[y0:y1, x0:x1])
        assert truth.max() > 0.01


def test_flashgs_is_given_covariances():
    subject = peers_scenes.random(50, 0, "cpu")
    expected = project.covariance(subject.gaussians.quats.numpy(), subject.gaussians.scales.numpy())
    upper = peers_draw.covariances(subject.gaussians).numpy()
    size = np.abs(expected).max((1, 2))[:, None]
    rows, columns = np.triu_indices(3)
    np.testing.assert_allclose(upper / size, expected[:, rows, columns] / size, atol=1e-6)


def test_captured_assets_are_seen_from_above(folder):
    subject = peers_scenes.captured(folder, "thing", "cpu")
    for camera, steep in zip(subject.cameras.values(), (False, True), strict=True):
        view = subject.gaussians.means.numpy() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        px = view[:, :2] / view[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        inside = ((px > 0) & (px < [camera.width, camera.height])).all(1) & (view[:, 2] > 0)
        assert inside.mean() > 0.85
        # looks down along the world's z axis
        assert (camera.viewmat[2, 2] < -0.9) == steep
