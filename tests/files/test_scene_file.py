import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from random_bundle import random_bundle
from v3dg import Camera, Scene, read_scene, write_scene

BUNDLE = random_bundle(1)
OTHER = random_bundle(2)

coordinate = st.floats(-1e9, 1e9)


@given(
    positions=st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=5),
    seed=st.integers(0, 2**32 - 1),
)
def test_written_scene_reads_back_the_same(tmp_path_factory, positions, seed):
    rng = np.random.default_rng(seed)
    scene = Scene()
    for position in positions:
        bundle = BUNDLE if rng.random() < 0.5 else OTHER
        importance = 1.0 if rng.random() < 0.5 else np.exp(rng.normal())
        scene.add(
            bundle,
            position,
            rng.normal(size=4),
            np.exp(rng.normal()),
            importance,
            opacity=rng.choice([1.0, rng.random()]),
            tint=(1, 1, 1) if rng.random() < 0.5 else rng.random(3),
        )
    eye = 100 * rng.normal(size=3)
    cameras = {
        "a": Camera.look_at(eye, eye + rng.normal(size=3), width=64, height=48, near=0.5),
        "b": Camera(np.eye(4), np.diag([3.0, 4.0, 1.0]), 5, 6),
    }
    path = tmp_path_factory.mktemp("scene") / "scene.json"
    paths = {id(BUNDLE): "one.v3dg", id(OTHER): "two.v3dg"}
    write_scene(path, scene, [paths[id(bundle)] for bundle in scene.bundles], cameras)
    again, cameras_again = read_scene(path, bundles={"one.v3dg": BUNDLE, "two.v3dg": OTHER})
    assert [scene.bundles[b] for b in scene.instance_bundle] == [
        again.bundles[b] for b in again.instance_bundle
    ]
    np.testing.assert_array_equal(again.positions, scene.positions)
    np.testing.assert_allclose(again.quaternions, scene.quaternions, atol=1e-15)
    np.testing.assert_array_equal(again.scales, scene.scales)
    np.testing.assert_array_equal(again.importance, scene.importance)
    np.testing.assert_array_equal(again.opacity, scene.opacity)
    np.testing.assert_array_equal(again.tint, scene.tint)
    written = json.loads(path.read_text(encoding="utf-8"))["instances"]
    assert ["importance" in instance for instance in written] == (scene.importance != 1).tolist()
    assert list(cameras_again) == list(cameras)
    for name, camera in cameras.items():
        np.testing.assert_array_equal(cameras_again[name].viewmat, camera.viewmat)
        np.testing.assert_array_equal(cameras_again[name].K, camera.K)
        assert cameras_again[name].near == camera.near
        assert (cameras_again[name].width, cameras_again[name].height) == (
            camera.width,
            camera.height,
        )
    assert [entry.name for entry in path.parent.iterdir()] == ["scene.json"]


GOOD = {
    "format": "v3dg-scene",
    "version": 1,
    "bundles": {"donut": "sub/donut.v3dg"},
    "instances": [{"bundle": "donut", "position": [i, 0, 0]} for i in range(4)],
    "cameras": [
        {"name": "front", "width": 64, "height": 48, "eye": [0, -8, 2], "target": [0, 0, 0]},
        {
            "name": "matrices",
            "width": 64,
            "height": 48,
            "viewmat": np.eye(4).tolist(),
            "K": np.diag([50, 50, 1]).tolist(),
        },
    ],
}


def put(path, document):
    path.write_text(
        document if isinstance(document, str) else json.dumps(document), encoding="utf-8"
    )
    return path


def test_instances_are_added_at_once_whatever_their_order(tmp_path, monkeypatch):
    """Adding all instances at once takes time proportional to their number.

    Adding them one by one would take time proportional to its square.
    """
    instances = [{"bundle": "ab"[i % 2], "position": [i, 0, 0]} for i in range(100)]
    document = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"a": "a", "b": "b"},
        "instances": instances,
    }
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(document))
    calls, add = [], Scene.add
    monkeypatch.setattr(
        Scene, "add", lambda *given, **named: calls.append(given) or add(*given, **named)
    )
    scene, _ = read_scene(path, bundles={"a": BUNDLE, "b": OTHER})
    assert len(calls) == 1
    np.testing.assert_array_equal(scene.instance_bundle, np.arange(100) % 2)
    np.testing.assert_array_equal(scene.positions[:, 0], np.arange(100))


def test_bundles_are_opened_beside_the_file(tmp_path):
    (tmp_path / "sub").mkdir()
    BUNDLE.write(tmp_path / "sub" / "donut.v3dg")
    scene, cameras = read_scene(put(tmp_path / "scene.json", GOOD))
    assert len(scene.bundles) == 1
    np.testing.assert_array_equal(scene.bundles[0].groups.ball, BUNDLE.groups.ball)
    np.testing.assert_array_equal(scene.positions[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(cameras["front"].position, [0, -8, 2])


def test_missing_bundle_is_named(tmp_path):
    path = put(tmp_path / "scene.json", GOOD)
    with pytest.raises(
        FileNotFoundError, match=r"scene\.json: bundles\.donut: expected a bundle at .*donut"
    ):
        read_scene(path)


def changed(place, value, document=GOOD):
    """Return the document with the value at a path of keys and indices replaced. None
    removes it."""
    document = json.loads(json.dumps(document))
    target = document
    for key in place[:-1]:
        target = target[key]
    if value is None:
        del target[place[-1]]
    else:
        target[place[-1]] = value
    return document


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (["instances", 3, "scale"], -1, "instances[3].scale: expected a positive number, got -1"),
        (["instances", 3, "scale"], True, "instances[3].scale: expected a number, got true"),
        (
            ["instances", 3, "importance"],
            0,
            "instances[3].importance: expected a positive number, got 0",
        ),
        (
            ["instances", 3, "importance"],
            "x",
            'instances[3].importance: expected a number, got "x"',
        ),
        (
            ["instances", 3, "importance"],
            1e39,
            "instances[3].importance: expected a positive number that a",
        ),
        (
            ["instances", 3, "importance"],
            1e-50,
            "instances[3].importance: expected a positive number that a",
        ),
        (
            ["instances", 0, "position"],
            [1, 2],
            "instances[0].position: expected 3 numbers, got [1, 2]",
        ),
        (
            ["instances", 0, "position", 1],
            "x",
            'instances[0].position[1]: expected a number, got "x"',
        ),
        (
            ["instances", 0, "position", 1],
            10**400,
            "instances[0].position[1]: expected a finite number, got 1000",
        ),
        (
            ["instances", 1, "quaternion"],
            [0, 0, 0, 0],
            "instances[1].quaternion: expected a nonzero quaternion",
        ),
        (
            ["instances", 1, "bundle"],
            "tree",
            'instances[1].bundle: expected a name in bundles, got "tree"',
        ),
        (
            ["instances", 1, "position"],
            None,
            "instances[1]: expected the field position, got an object",
        ),
        (
            ["instances", 1, "rotation"],
            1,
            "instances[1].rotation: expected one of bundle, scene, position",
        ),
        (["instances", 2], 7, "instances[2]: expected an object, got 7"),
        (["instances"], {}, "instances: expected an array, got {}"),
        (["bundles"], ["a"], "bundles: expected an object, got"),
        (["bundles", "donut"], 3, "bundles.donut: expected a string, got 3"),
        (["format"], "gltf", 'format: expected "v3dg-scene", got "gltf"'),
        (["version"], 2, "version: expected version 1, the only one that can be read, got 2"),
        (["version"], None, "top level: expected the field version"),
        (["cameras", 0, "width"], 0, "cameras[0].width: expected a positive whole number, got 0"),
        (
            ["cameras", 0, "target"],
            None,
            "cameras[0]: expected either viewmat and K, or eye and target",
        ),
        (
            ["cameras", 0, "target"],
            [0, -8, 2],
            "cameras[0].target: expected a point away from the eye",
        ),
        (["cameras", 0, "fov_x"], 4, "cameras[0].fov_x: expected radians between 0 and pi, got 4"),
        (
            ["cameras", 1, "name"],
            "front",
            "cameras[1].name: expected a name that no other camera has",
        ),
        (["cameras", 1, "viewmat", 2], [0, 0, 1], "cameras[1].viewmat[2]: expected 4 numbers"),
        (["cameras", 1, "viewmat", 2, 2], -1, "cameras[1].viewmat: expected a rotation"),
        (["cameras", 1, "K", 0, 0], 0, "cameras[1].K: expected positive focal lengths"),
        (["cameras", 1, "near"], 0, "cameras[1].near: expected a positive number, got 0"),
        (
            ["cameras", 1, "up"],
            [0, 0, 1],
            "cameras[1]: expected either viewmat and K, or eye and target",
        ),
    ],
)
def test_bad_values_are_named_by_their_place(tmp_path, place, value, message):
    path = put(tmp_path / "scene.json", changed(place, value))
    with pytest.raises(ValueError, match="^" + re.escape(f"scene.json: {message}")):
        read_scene(path, bundles={"sub/donut.v3dg": BUNDLE})


@pytest.mark.parametrize(
    "text", ["", "{", "[1, NaN]", "\ud83d".encode("utf-16", "surrogatepass"), "[" * 100_000]
)
def test_files_that_are_not_json_are_refused(tmp_path, text):
    path = tmp_path / "scene.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(
        ValueError, match=r"scene\.json: expected JSON, got a file that does not parse"
    ):
        read_scene(path)


@pytest.mark.parametrize("text", ["[]", "3", "null", '"x"'])
def test_json_that_is_no_scene_is_refused(tmp_path, text):
    with pytest.raises(ValueError, match=r"scene\.json: top level: expected an object, got"):
        read_scene(put(tmp_path / "scene.json", text))


MATRIX = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]


def published_layout():
    """Write a layout as in the published code of V3DG: two assets, one with notes of
    the program that placed it."""
    camera = {
        "camera_name": "camera_0",
        "camera_width": 64,
        "camera_height": 48,
        "camera_angle_x": 0.8,
        "camera_angle_y": 0.6,
        "transform_matrix": MATRIX,
    }
    pose = {"scale": 0.5, "quaternions": [1, 0, 0, 0], "positions": [0, 0, 0]}
    other = {"scale": 2.0, "quaternions": [0, 1, 0, 0], "positions": [1, 2, 3]}
    asset = {
        "ply_suffix": "point_cloud/fused.ply",
        "bundle_kind": "trees",
        "bundle_name": "oak_250414_n4096",
    }
    return {
        "layouts": [
            {
                "layout_name": "layout_0",
                "assets": [
                    {
                        "asset_kind": "trees",
                        "asset_name": "oak",
                        **asset,
                        "instances": [pose, other],
                    },
                    {
                        "asset_kind": "donut",
                        "asset_name": "donut",
                        **asset,
                        "scene_max_3d_box": [1, 1, 1],
                        "instances": [
                            {"i_asset": 1, "instance_name": "instance_2", "center_x": 0.1, **pose}
                        ],
                    },
                ],
                "cameras": [camera, {**camera, "camera_name": "camera_1"}],
            }
        ]
    }


def test_published_layouts_are_read(tmp_path):
    path = put(tmp_path / "layout.json", published_layout())
    scene, cameras = read_scene(path, bundles={"oak": BUNDLE, "donut": OTHER})
    assert scene.bundles == (BUNDLE, OTHER)
    np.testing.assert_array_equal(scene.instance_bundle, [0, 0, 1])
    np.testing.assert_array_equal(scene.scales, [0.5, 2, 0.5])
    np.testing.assert_array_equal(scene.positions[1], [1, 2, 3])
    np.testing.assert_array_equal(scene.rotations[1], np.diag([1, -1, -1]))
    assert list(cameras) == ["camera_0", "camera_1"]
    camera = cameras["camera_0"]
    np.testing.assert_allclose(camera.position, [0, -5, 1])
    # the camera looks along y
    np.testing.assert_allclose(camera.viewmat[2, :3], [0, 1, 0], atol=1e-12)
    assert camera.fx == pytest.approx(32 / np.tan(0.4))
    assert camera.fy == pytest.approx(24 / np.tan(0.3))


def test_published_layouts_find_bundles_where_a_build_puts_them(tmp_path):
    """The bundles are in the folder of the layout, or with the assets of the published
    code."""
    (tmp_path / "layouts").mkdir()
    path = put(tmp_path / "layouts" / "layout.json", published_layout())
    with pytest.raises(
        FileNotFoundError, match=r"layouts\[0\]\.assets\[0\]\.asset_name: .*oak\.v3dg or "
    ):
        read_scene(path)
    BUNDLE.write(tmp_path / "layouts" / "donut.v3dg")
    place = tmp_path / "_3dgs-assets" / "trees" / "oak" / "point_cloud"
    place.mkdir(parents=True)
    OTHER.write(place / "fused.v3dg")
    scene, _ = read_scene(path)
    assert [bundle.num_gaussians for bundle in scene.bundles] == [
        OTHER.num_gaussians,
        BUNDLE.num_gaussians,
    ]


def test_repeated_camera_names_of_a_layout_get_their_place(tmp_path):
    layout = published_layout()
    layout["layouts"][0]["cameras"][1]["camera_name"] = "camera_0"
    path = put(tmp_path / "layout.json", layout)
    _, cameras = read_scene(path, bundles={"oak": BUNDLE, "donut": OTHER})
    assert list(cameras) == ["000_camera_0", "001_camera_0"]


def flat_layout():
    return {
        "name": "Sea",
        "asset": "donut.ply",
        "convention": "camera to world",
        "instances": [
            {"scale": 0.5, "quaternion": [1, 0, 0, 0], "position": [0, 0, 0]},
            {"scale": 2, "quaternion": [0, 1, 0, 0], "position": [1, 2, 3]},
        ],
        "cameras": [
            {
                "name": "0",
                "width": 64,
                "height": 48,
                "fov_x": 0.8,
                "fov_y": 0.6,
                "transform_matrix": MATRIX,
            }
        ],
    }


def test_flat_layouts_are_read(tmp_path):
    path = put(tmp_path / "layout.json", flat_layout())
    scene, cameras = read_scene(path, bundles={"donut.ply": BUNDLE})
    np.testing.assert_array_equal(scene.scales, [0.5, 2])
    np.testing.assert_allclose(cameras["0"].position, [0, -5, 1])
    with pytest.raises(
        FileNotFoundError, match=r"layout\.json: asset: expected a bundle at .*donut\.v3dg"
    ):
        read_scene(path)
    BUNDLE.write(tmp_path / "donut.v3dg")
    assert len(read_scene(path)[0]) == 2


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (["layouts"], [], "layouts: expected one layout, got 0"),
        (["layouts"], [{}, {}], "layouts: expected one layout, got 2; each layout is a scene"),
        (["layouts", 0, "assets"], None, "layouts[0]: expected the field assets"),
        (
            ["layouts", 0, "assets", 1, "asset_name"],
            3,
            "layouts[0].assets[1].asset_name: expected a string",
        ),
        (
            ["layouts", 0, "assets", 0, "instances", 1, "scale"],
            0,
            "layouts[0].assets[0].instances[1].scale: expected a positive number, got 0",
        ),
        (
            ["layouts", 0, "cameras", 1, "transform_matrix", 0, 0],
            2,
            "layouts[0].cameras[1].transform_matrix: expected a rotation",
        ),
        (
            ["layouts", 0, "cameras", 1, "camera_angle_x"],
            4,
            "layouts[0].cameras[1].camera_angle_x: expected radians between 0 and pi, got 4",
        ),
    ],
)
def test_bad_layouts_are_named_by_their_place(tmp_path, place, value, message):
    path = put(tmp_path / "layout.json", changed(place, value, published_layout()))
    with pytest.raises(ValueError, match="^" + re.escape(f"layout.json: {message}")):
        read_scene(path, bundles={"oak": BUNDLE, "donut": OTHER})


def test_write_refuses_missing_paths(tmp_path):
    with pytest.raises(ValueError, match="bundle_paths: expected 1 paths, got 0"):
        write_scene(tmp_path / "scene.json", Scene.of(BUNDLE), [])
    assert list(tmp_path.iterdir()) == []
