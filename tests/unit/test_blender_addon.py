"""Tests the parts of the Blender add-on that need no Blender: cameras, cuts, the pace,
and its archive."""

import importlib.util
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import scenes_lod
import v3dg
from v3dg.rotations import product

FOLDER = Path(__file__).parents[2] / "integrations" / "blender"


def load(name):
    """Import a file of the add-on without its package, which needs bpy."""
    spec = importlib.util.spec_from_file_location(f"blender_{Path(name).stem}", FOLDER / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


cuts = load("v3dg_blender/cuts.py")
pace = load("v3dg_blender/pace.py")
views = load("v3dg_blender/views.py")
pack = load("pack.py")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("blender") / "blob.v3dg"
    scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 800, sh_degree=1), 32).write(path)
    return v3dg.Bundle.open(path)


def perspective(fx, fy, cx, cy, width, height):
    """Return the projection matrix of OpenGL, near 1 and far 3."""
    return np.array(
        [
            [2 * fx / width, 0, 1 - 2 * cx / width, 0],
            [0, 2 * fy / height, 2 * cy / height - 1, 0],
            [0, 0, -2, -3],
            [0, 0, -1, 0],
        ]
    )


def clip_pixels(view_from_world, projection, points, width, height):
    """Return the pixels (N, 2) at which OpenGL draws points, with v down."""
    matrix = projection @ view_from_world
    clip = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    device = clip[:, :2] / clip[:, 3:]
    return (device * [1, -1] + 1) / 2 * [width, height]


def camera_pixels(camera, points):
    rotated = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return (rotated @ camera.K.T / rotated[:, 2:])[:, :2]


def view_matrix():
    look = v3dg.Camera.look_at((3, -4, 2), (0.1, 0.2, 0), width=9, height=9)
    return np.diag([1.0, -1.0, -1.0, 1.0]) @ look.viewmat


def test_a_perspective_view_sees_what_opengl_draws():
    points = np.random.default_rng(1).normal(0, 0.5, (30, 3))
    projection = perspective(300, 280, 100, 90, 240, 160)
    camera = views.camera_of_projection(view_matrix(), projection, 240, 160, 0.1)
    expected = clip_pixels(view_matrix(), projection, points, 240, 160)
    np.testing.assert_allclose(camera_pixels(camera, points), expected, atol=1e-8)
    assert camera.near == 0.1


def test_a_scaled_camera_sees_the_same():
    scaled = np.linalg.inv(np.linalg.inv(view_matrix()) @ np.diag([2.0, 2.0, 2.0, 1.0]))
    projection = perspective(300, 280, 100, 90, 240, 160)
    plain = views.camera_of_projection(view_matrix(), projection, 240, 160, 0.1)
    camera = views.camera_of_projection(scaled, projection, 240, 160, 0.1)
    np.testing.assert_allclose(camera.viewmat, plain.viewmat, atol=1e-12)


def test_an_orthographic_view_is_seen_from_afar():
    points = np.random.default_rng(1).normal(0, 0.5, (30, 3))
    projection = np.diag([0.4, 0.6, -0.1, 1.0])
    projection[:2, 3] = (0.1, -0.2)
    camera = views.camera_of_projection(view_matrix(), projection, 300, 200, 0.1)
    expected = clip_pixels(view_matrix(), projection, points, 300, 200)
    # Depths of the points differ by 1 % of the distance to the eye.
    np.testing.assert_allclose(camera_pixels(camera, points), expected, atol=0.01 * 300)


def test_a_viewport_has_a_camera():
    projection = perspective(300, 280, 100, 90, 240, 160)
    region = SimpleNamespace(width=240, height=160)
    view = SimpleNamespace(view_matrix=view_matrix().tolist(), window_matrix=projection.tolist())
    camera = views.viewport_camera(region, view, 0.2)
    expected = views.camera_of_projection(view_matrix(), projection, 240, 160, 0.2)
    np.testing.assert_array_equal(camera.viewmat, expected.viewmat)
    np.testing.assert_array_equal(camera.K, expected.K)


def crowd(bundle):
    """Return a scene with a near instance, and far ones of two appearances."""
    scene = v3dg.Scene()
    scene.add(bundle, (0, 0, 0), up="z")
    far = np.column_stack([np.arange(6) - 3.0, np.full(6, 900.0), np.zeros(6)])
    scene.add(bundle, far, opacity=[1, 1, 1, 1, 0.5, 0.5], up="z")
    return scene


def crowd_cut(bundle):
    camera = v3dg.Camera.look_at((0, -4, 0), (0, 0, 0), width=300, height=200)
    return v3dg.select(crowd(bundle), camera, device="cpu")


def test_equal_cuts_are_one_cut(bundle):
    shared = cuts.distinct_cuts(crowd_cut(bundle))
    assert sorted(shared) == list(range(7))
    assert len({id(cut) for cut in shared.values()}) == 3
    assert shared[1] is shared[2] is shared[3] is shared[4]
    assert shared[5] is shared[6]
    assert len({cut.digest for cut in shared.values()}) == 3


def test_another_file_has_other_cuts(bundle):
    before = cuts.distinct_cuts(crowd_cut(bundle))
    path = Path(bundle.path)
    other = path.with_name("other.v3dg")
    other.write_bytes(path.read_bytes())
    after = cuts.distinct_cuts(crowd_cut(v3dg.Bundle.open(other)))
    assert not {cut.digest for cut in before.values()} & {cut.digest for cut in after.values()}


def test_cuts_have_the_gaussians_of_the_selection(bundle):
    selection = crowd_cut(bundle)
    shared = cuts.distinct_cuts(selection)
    gaussians = cuts.gaussians_of(list(shared.values()))
    assert [len(item) for item in gaussians] == [cut.num_gaussians for cut in shared.values()]
    expected = selection.gaussians(device="cpu")
    means = [
        item.means + position
        for item, position in zip(gaussians, selection.scene.positions, strict=True)
    ]
    np.testing.assert_allclose(np.concatenate(means), expected.means, rtol=1e-5, atol=1e-5)
    for name in ("scales", "opacities", "sh"):
        values = np.concatenate([getattr(item, name) for item in gaussians])
        np.testing.assert_allclose(values, getattr(expected, name), rtol=1e-5, atol=1e-6)
    quats = np.concatenate([item.quats for item in gaussians])
    inverse = expected.quats * [1, -1, -1, -1]
    turned = product(quats, inverse)
    np.testing.assert_allclose(turned[:, 1:], 0, atol=1e-5)


def test_nothing_has_no_cuts(bundle):
    camera = v3dg.Camera.look_at((0, -400, 0), (0, -900, 0), width=300, height=200)
    assert cuts.distinct_cuts(v3dg.select(crowd(bundle), camera, device="cpu")) == {}
    assert cuts.gaussians_of([]) == []


def test_a_cut_is_due_when_something_changed_and_the_last_one_is_over():
    due = pace.Pace()
    assert due.is_due("here", 0.0)
    due.record("here", 1.0, 0.5)
    assert not due.is_due("here", 10.0)
    # The pause is twice as long as the cut took.
    assert not due.is_due("there", 1.9)
    assert due.is_due("there", 2.1)
    due.forget()
    assert due.is_due("here", 2.1)
    due.record("here", 3.0, 0.0)
    assert not due.is_due("there", 3.1)


def test_the_archive_has_the_sources_and_the_wheels(tmp_path):
    tomllib = pytest.importorskip("tomllib")  # since Python 3.11
    wheels = [tmp_path / name for name in ("a-1-py3-none-any.whl", "b-2-py3-none-any.whl")]
    for wheel in wheels:
        wheel.write_bytes(b"wheel")
    (tmp_path / "out").mkdir()
    archive = tmp_path / "out" / "v3dg_blender.zip"
    pack.pack(archive, wheels)
    with zipfile.ZipFile(archive) as file:
        names = file.namelist()
        manifest = tomllib.loads(file.read("blender_manifest.toml").decode())
    assert manifest["wheels"] == [
        "./wheels/a-1-py3-none-any.whl",
        "./wheels/b-2-py3-none-any.whl",
    ]
    assert {"__init__.py", "panel.py", "wheels/a-1-py3-none-any.whl"} <= set(names)
    assert not [name for name in names if "__pycache__" in name]
    assert manifest["version"] == v3dg.__version__


@pytest.mark.parametrize("name", ["missing.whl", "notes.txt"])
def test_only_wheels_are_packed(tmp_path, name):
    if name == "notes.txt":
        (tmp_path / name).write_text("no wheel")
    with pytest.raises(ValueError, match=f"{name}: expected"):
        pack.pack(tmp_path / "out.zip", [tmp_path / name])
    assert not (tmp_path / "out.zip").exists()
