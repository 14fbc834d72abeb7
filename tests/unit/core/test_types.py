"""Values that are passed to the compiled module. Each class rejects wrong values and
names them."""

import re

import numpy as np
import pytest

import scenes
from random_bundle import random_bundle
from reference import sh
from v3dg import _core
from v3dg._device import CPU
from v3dg.residency import residency

CAMERA = {
    "viewmat": np.eye(4),
    "K": np.diag([50.0, 50.0, 1.0]),
    "width": 64,
    "height": 48,
    "near": 0.01,
}
SHADE = _core.Shade(background=[0, 0, 0], min_transmittance=1e-3, with_depth=True)
RULE = {
    "tolerance_px2": 3.0,
    "budget": None,
    "min_level": 0,
    "footprint": "solid_angle",
    "culls": True,
}
INSTANCES = {
    "bundle": np.zeros(2, np.int32),
    "positions": np.zeros((2, 3)),
    "quaternions": np.tile([1.0, 0, 0, 0], (2, 1)),
    "scales": np.ones(2),
    "importance": np.ones(2, np.float32),
}
FIT = {
    **dict.fromkeys(
        ("steps", "views_per_step", "num_views", "supersample", "image_size", "seed"), 1
    ),
    **dict.fromkeys(("px2_per_gaussian", "distance", "filter_px2", "final_step", "beta2"), 1.0),
    **dict.fromkeys(("loss_l1", "loss_dssim", "loss_alpha", "loss_cells"), 1.0),
    **dict.fromkeys(("step_position", "step_log_scale", "step_quat"), 1.0),
    **dict.fromkeys(("step_logit", "step_sh0", "step_sh_rest"), 1.0),
    **dict.fromkeys(("antialiased", "position_in_world"), True),
}
KINDS = {
    _core.Camera: CAMERA,
    _core.Rule: RULE,
    _core.Instances: INSTANCES,
    _core.FitConfig: FIT,
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_argument_has_to_be_given_by_name(kind):
    given = KINDS[kind]
    kind(**given)
    for name in given:
        with pytest.raises(TypeError, match="incompatible constructor arguments"):
            kind(**{key: value for key, value in given.items() if key != name})
    with pytest.raises(TypeError, match="incompatible constructor arguments"):
        kind(*given.values())
    with pytest.raises(TypeError, match="incompatible constructor arguments"):
        kind(**given, other=1)


@pytest.mark.parametrize("name", FIT)
def test_a_setting_of_another_type_is_refused(name):
    with pytest.raises(TypeError, match="incompatible constructor arguments"):
        _core.FitConfig(**FIT | {name: "many"})


# ---- Camera


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"viewmat": np.eye(3)}, ValueError, "viewmat: expected shape (4, 4), got (3, 3)"),
        (
            {"viewmat": np.eye(4, dtype=np.float32)},
            ValueError,
            "viewmat: expected dtype float64, got float3",
        ),
        ({"viewmat": np.eye(8)[::2, ::2]}, ValueError, "viewmat: expected a C-contiguous array"),
        ({"viewmat": np.eye(4).tolist()}, TypeError, "incompatible constructor arguments"),
        ({"K": np.eye(4)}, ValueError, "K: expected shape (3, 3), got (4, 4)"),
        ({"width": 0}, ValueError, "width, height: expected 1 to 65535 px, got 0 x 48"),
        ({"height": 1 << 16}, ValueError, "width, height: expected 1 to 65535 px, got 64 x 65536"),
        ({"width": 64.5}, TypeError, "incompatible constructor arguments"),
        ({"near": None}, TypeError, "incompatible constructor arguments"),
    ],
)
def test_wrong_cameras_are_refused(change, error, message):
    with pytest.raises(error, match=re.escape(message)):
        _core.Camera(**CAMERA | change)


@pytest.mark.parametrize(
    "window",
    [(-1, 0, 3, 3), (0, -1, 3, 3), (0, 0, 65, 3), (0, 0, 3, 49), (5, 5, 5, 9), (5, 9, 9, 5)],
)
def test_windows_outside_of_the_picture_are_refused(window):
    message = f"window: expected x0 < x1 and y0 < y1 within 64 x 48 px, got {window}"
    with pytest.raises(ValueError, match=re.escape(message)):
        _core.Camera(**CAMERA).window(*window)


def test_window_leaves_the_camera_as_it_was():
    """A window of a window, anywhere in the picture, is possible, too."""
    camera = _core.Camera(**CAMERA)
    part = camera.window(10, 10, 20, 20)
    assert part is not camera
    part.window(0, 0, 64, 48)
    np.testing.assert_array_equal(part.position, camera.position)


def test_camera_does_not_follow_the_matrix_that_it_was_made_of():
    viewmat = np.eye(4)
    viewmat[:3, 3] = (1, 2, 3)
    camera = _core.Camera(**CAMERA | {"viewmat": viewmat})
    viewmat[:3, 3] = 7
    np.testing.assert_array_equal(camera.position, (-1, -2, -3))
    camera.position[:] = 0
    np.testing.assert_array_equal(camera.position, (-1, -2, -3))


# ---- Rule


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"footprint": "ball"}, ValueError, "footprint: expected solid_angle or paper, got ball"),
        ({"footprint": None}, TypeError, "incompatible constructor arguments"),
        ({"budget": -1}, TypeError, "incompatible constructor arguments"),
        ({"budget": 1.5}, TypeError, "incompatible constructor arguments"),
        ({"tolerance_px2": "3"}, TypeError, "incompatible constructor arguments"),
        ({"min_level": 1 << 31}, TypeError, "incompatible constructor arguments"),
    ],
)
def test_wrong_rules_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        _core.Rule(**RULE | change)


def test_rule_has_the_tolerance_that_is_compared_with():
    assert _core.Rule(**RULE | {"tolerance_px2": 0.1}).tolerance_px2 == float(np.float32(0.1))
    assert _core.Rule(**RULE | {"budget": 10**12}).tolerance_px2 == 3


# ---- Instances


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("bundle", np.zeros(2, np.int64), "bundle: expected dtype int32, got int64"),
        ("bundle", np.zeros((2, 1), np.int32), "bundle: expected shape (N,), got (2, 1)"),
        ("positions", np.zeros((3, 3)), "positions: expected shape (2, 3), got (3, 3)"),
        (
            "positions",
            np.zeros((2, 3), np.float32),
            "positions: expected dtype float64, got float32",
        ),
        ("quaternions", np.zeros((2, 3)), "quaternions: expected shape (2, 4), got (2, 3)"),
        ("scales", np.ones((2, 1)), "scales: expected shape (2,), got (2, 1)"),
        ("scales", np.ones(4)[::2], "scales: expected a C-contiguous array"),
        ("importance", np.ones(2), "importance: expected dtype float32, got float64"),
        ("importance", np.ones(3, np.float32), "importance: expected shape (2,), got (3,)"),
    ],
)
def test_wrong_instances_are_refused(name, value, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        _core.Instances(**INSTANCES | {name: value})
    with pytest.raises(TypeError, match="incompatible constructor arguments"):
        _core.Instances(**INSTANCES | {name: INSTANCES[name].tolist()})


@pytest.mark.parametrize("bundle", [-1, 1])
def test_instances_of_no_bundle_are_refused(bundle):
    instances = _core.Instances(**INSTANCES | {"bundle": np.array([0, bundle], np.int32)})
    arguments = {
        "instance": np.zeros(0, np.int32),
        "first_row": np.zeros(0, np.int64),
        "offset": np.zeros(1, np.int64),
    }
    rows = scenes.gaussians([[0, 0, 1]]).rows
    with pytest.raises(ValueError, match=f"bundle: expected an index below 1, got {bundle}"):
        _core.gather(bundles=[rows], instances=instances, device=-1, **arguments)


# ---- Rows

SHAPES = {"means": (4, 3), "quats": (4, 4), "scales": (4, 3), "opacities": (4,), "sh": (4, 9, 3)}


def rows(dtype=np.float32, **changes):
    return _core.Rows(**{name: np.zeros(shape, dtype) for name, shape in SHAPES.items()} | changes)


def test_rows_say_what_they_are():
    for dtype in (np.float32, np.float64):
        assert (len(rows(dtype)), rows(dtype).sh_degree, rows(dtype).device) == (4, 2, -1)
    assert len(scenes.gaussians(np.zeros((0, 3))).rows) == 0


@pytest.mark.parametrize("name", SHAPES)
def test_rows_of_mixed_types_are_refused(name):
    other = {"means": "quats"}.get(name, name)  # the first that does not match the means
    for dtype, wrong in ((np.float32, np.float64), (np.float64, np.float32)):
        expected, got = (dtype, wrong) if name != "means" else (wrong, dtype)
        message = f"{other}: expected dtype {np.dtype(expected)}, got {np.dtype(got)}"
        with pytest.raises(ValueError, match=message):
            rows(dtype, **{name: np.zeros(SHAPES[name], wrong)})
    with pytest.raises(ValueError, match=f"{name}: expected dtype float32, got float16"):
        rows(**{name: np.zeros(SHAPES[name], np.float16)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": (4, 2)}, "means: expected shape (4, 3), got (4, 2)"),
        ({"means": (12,)}, "means: expected shape (N, 3), got (12,)"),
        ({"quats": (5, 4)}, "quats: expected shape (4, 4), got (5, 4)"),
        ({"scales": (4, 1)}, "scales: expected shape (4, 3), got (4, 1)"),
        ({"opacities": (4, 1)}, "opacities: expected shape (4,), got (4, 1)"),
        ({"sh": (4, 5, 3)}, "sh: expected shape (N, K, 3) with K = 1, 4, 9 or 16, got (4, 5, 3)"),
        (
            {"sh": (4, 25, 3)},
            "sh: expected shape (N, K, 3) with K = 1, 4, 9 or 16, got (4, 25, 3)",
        ),
        ({"sh": (4, 27)}, "sh: expected shape (N, K, 3) with K = 1, 4, 9 or 16, got (4, 27)"),
        ({"sh": (3, 9, 3)}, "sh: expected shape (4, 9, 3), got (3, 9, 3)"),
    ],
)
def test_rows_of_wrong_shapes_are_refused(change, message):
    arrays = {name: np.zeros(shape, np.float32) for name, shape in change.items()}
    with pytest.raises(ValueError, match=re.escape(message)):
        rows(**arrays)


@pytest.mark.parametrize("name", SHAPES)
def test_what_is_no_array_is_refused(name):
    for value in (None, [0.0] * 4, "means"):
        with pytest.raises(
            TypeError, match=rf"{name}: expected .*, got <class '{type(value).__name__}'>"
        ):
            rows(**{name: value})


def test_rows_keep_what_they_borrow():
    held = rows(means=np.full((4, 3), 2, np.float32))
    box = _core.bound_by_boxes(held, np.array([0, 4]))
    np.testing.assert_allclose(box, np.full((1, 2, 3), 2), rtol=2e-6)


def test_operations_on_doubles_are_refused():
    """All operations except the rasterizer compute in float32."""
    offset = np.array([0, 4])
    for operation in (
        lambda g: _core.bound_by_boxes(g, offset),
        lambda g: _core.prune(g, offset, offset),
        lambda g: _core.merge(g, offset, offset),
        lambda g: _core.FitTarget(g, 0.0, False),
        _core.Model,
    ):
        with pytest.raises(ValueError, match="means: expected dtype float32, got float64"):
            operation(rows(np.float64))


# ---- functions that take these values


def test_other_values_are_refused():
    camera, rule = _core.Camera(**CAMERA), _core.Rule(**RULE)
    scene, frame, model = _core.ResidentScene(-1), _core.SceneFrame(-1), _core.Model(rows())
    request = _core.FrameRequest(camera, rule, SHADE)
    for wrong in (None, 3, camera):
        kind = type(wrong).__name__
        for name, expected, call in (
            ("tables", "ClusterTable", lambda w=wrong: scene.set_bundles([w])),
            ("models", "Model", lambda w=wrong: frame.set_models([w], [])),
            ("palettes", "Palette", lambda w=wrong: frame.set_models([model], [w])),
            (
                "table",
                "ClusterTable",
                lambda w=wrong: _core.Palette(w, np.zeros((1, 3), np.float32), -1),
            ),
            ("scene", "ResidentScene", lambda w=wrong: frame.draw(w, request)),
            ("model", "Model", lambda w=wrong: _core.AssetFrame(w)),
            ("request", "FrameRequest", lambda w=wrong: frame.draw(scene, w)),
        ):
            with pytest.raises(
                TypeError, match=rf"{name}: expected {expected}, got <class '.*{kind}'>"
            ):
                call()
        with pytest.raises(TypeError, match="incompatible function arguments"):
            _core.group_metrics([wrong], _core.Instances(**INSTANCES), camera, rule)


def test_frame_refuses_a_scene_of_other_bundles():
    """A frame may have the gaussians of bundles that the scene does not have yet, but
    not those of other bundles in place of the scene's."""
    bundles = [random_bundle(seed) for seed in (1, 2)]
    one, two = map(residency.table, bundles)
    for has, tables in (
        (1, [two]),
        (1, [one, two]),
        (2, [two, one]),
        (0, [one]),
        (2, []),
        (2, [one]),
    ):
        frame, scene = _core.SceneFrame(-1), _core.ResidentScene(-1)
        frame.set_models([residency.model(bundle, CPU) for bundle in bundles[:has]], [])
        scene.set_bundles(tables)
        camera = _core.Camera(**CAMERA)
        rule = _core.Rule(**RULE)
        arguments = scene, _core.FrameRequest(camera, rule, SHADE)
        if tables == [one, two][: len(tables)] and len(tables) <= has:
            assert not frame.draw(*arguments).alpha.any()
            continue
        with pytest.raises(
            ValueError,
            match="scene: expected a scene of the bundles that the frame draws, got other",
        ):
            frame.draw(*arguments)


def test_background_has_three_numbers():
    for background in ([0, 0], [0, 0, 0, 0], None, "red"):
        with pytest.raises(TypeError, match="incompatible constructor arguments"):
            _core.Shade(background=background, min_transmittance=1e-3, with_depth=True)


@pytest.mark.parametrize("degree", range(4))
def test_bases_are_those_of_the_reference(degree):
    directions = np.random.default_rng(degree).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = _core.sh_bases(degree, directions)
    np.testing.assert_allclose(found, sh.basis(directions, degree), atol=1e-12)
    assert _core.sh_bases(degree, np.zeros((0, 3))).shape == (0, (degree + 1) ** 2)


def test_bases_of_what_is_no_direction_are_refused():
    with pytest.raises(ValueError, match="degree: expected 0 to 3, got 4"):
        _core.sh_bases(4, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="directions: expected"):
        _core.sh_bases(1, np.zeros((1, 2)))
