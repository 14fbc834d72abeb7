"""Scene files: up axes, matrices, opacity and tint, and nested scenes."""

import json
import re

import numpy as np
import pytest

from random_bundle import random_bundle
from v3dg import read_scene
from v3dg.scene import file as scene_file

BUNDLE = random_bundle(1)
QUARTER = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]


def put(path, *instances, scenes=(), **fields):
    """Write a scene file of a bundle `a` and of scenes by their names."""
    document = {"format": "v3dg-scene", "version": 1, "instances": list(instances), **fields}
    if any("bundle" in instance for instance in instances):
        document["bundles"] = {"a": "a.v3dg"}
    if scenes:
        document["scenes"] = {name: f"{name}.json" for name in scenes}
    path.write_text(json.dumps(document))
    return path


@pytest.fixture(scope="module")
def bundle_bytes(tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "a.v3dg"
    BUNDLE.write(path)
    return path.read_bytes()


@pytest.fixture
def folder(tmp_path, bundle_bytes):
    (tmp_path / "a.v3dg").write_bytes(bundle_bytes)
    return tmp_path


def test_up_of_an_instance_stands_it_upright(folder):
    scene, _ = read_scene(put(folder / "s.json", {"bundle": "a", "position": [0, 0, 0], "up": "z"}))
    assert scene.up == "z"
    np.testing.assert_allclose(scene.rotations[0] @ (0, -1, 0), (0, 0, 1), atol=1e-12)


def test_a_matrix_places_an_instance(folder):
    scene, _ = read_scene(put(folder / "s.json", {"bundle": "a", "matrix": QUARTER}))
    np.testing.assert_array_equal(scene.positions, [[5, 6, 7]])
    np.testing.assert_allclose(scene.rotations[0], np.array(QUARTER)[:3, :3], atol=1e-12)


def test_factors_are_read(folder):
    instance = {"bundle": "a", "position": [0, 0, 0], "opacity": 0.5, "tint": [1, 0, 0.25]}
    scene, _ = read_scene(put(folder / "s.json", instance))
    assert scene.factors.tolist() == [[1, 0, 0.25, 0.5]]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"matrix": np.diag([1, 1, 2, 1]).tolist()}, "instances[0].matrix: expected a rotation"),
        ({"matrix": QUARTER, "position": [0, 0, 0]}, "instances[0]: expected either matrix, or"),
        ({"matrix": [[1]]}, "instances[0].matrix: expected 4 rows of 4 numbers"),
        ({}, "instances[0]: expected the field position"),
        ({"position": [0, 0, 0], "up": "w"}, "instances[0].up: expected 'x' or 'y'"),
        ({"position": [0, 0, 0], "up": "z"}, "instances[0].up: expected y, the up axis of"),
        (
            {"position": [0, 0, 0], "opacity": 2},
            "instances[0].opacity: expected a number from 0 to",
        ),
        ({"position": [0, 0, 0], "tint": [1, 1]}, "instances[0].tint: expected 3 numbers"),
        (
            {"position": [0, 0, 0], "tint": [1, 1, -1]},
            "instances[0].tint: expected 3 numbers of at least 0",
        ),
        (
            {"position": [0, 0, 0], "scene": "b"},
            "instances[0]: expected exactly one of the fields bundle",
        ),
    ],
)
def test_wrong_placements_are_named(folder, fields, message):
    path = put(folder / "s.json", {"bundle": "a", **fields}, up="y")
    with pytest.raises(ValueError, match="^" + re.escape(f"s.json: {message}")):
        read_scene(path)


def test_scenes_are_placed_in_scenes(folder):
    (folder / "deep").mkdir()
    pair = [{"bundle": "a", "position": [x, 0, 0], "scale": 2} for x in (1, 3)]
    put(folder / "pair.json", *pair)
    row = [{"scene": "pair", "position": [0, y, 0], "opacity": 0.5} for y in (0, 10)]
    put(folder / "row.json", *row, {"bundle": "a", "position": [0, 0, 0]}, scenes=["pair"])
    town = {"scene": "row", "matrix": QUARTER, "tint": [1, 0, 1], "importance": 3}
    path = put(folder / "town.json", {"scene": "pair", "position": [0, 0, 9]}, town,
               scenes=["row", "pair"])  # fmt: skip
    scene, cameras = read_scene(path)
    assert (len(scene), len(scene.bundles), cameras) == (7, 1, {})
    local = np.array([[1, 0, 0], [3, 0, 0], [1, 10, 0], [3, 10, 0], [0, 0, 0]])
    turned = local @ np.array(QUARTER)[:3, :3].T + (5, 6, 7)
    np.testing.assert_allclose(scene.positions, [[1, 0, 9], [3, 0, 9], *turned], atol=1e-12)
    assert scene.scales.tolist() == [2, 2, 2, 2, 2, 2, 1]
    assert scene.opacity.tolist() == [1, 1, 0.5, 0.5, 0.5, 0.5, 1]
    assert scene.tint[2:].tolist() == [[1, 0, 1]] * 5
    assert scene.importance.tolist() == [1, 1, 3, 3, 3, 3, 3]


def test_the_path_of_a_nested_scene_is_relative_to_the_file_that_names_it(folder, bundle_bytes):
    (folder / "part").mkdir()
    (folder / "part" / "a.v3dg").write_bytes(bundle_bytes)
    put(folder / "part" / "b.json", {"bundle": "a", "position": [0, 0, 0]})
    document = {"scene": "b", "position": [1, 2, 3]}
    path = put(folder / "s.json", document, **{"scenes": {}})
    text = json.loads(path.read_text())
    text["scenes"] = {"b": "part/b.json"}
    path.write_text(json.dumps(text))
    scene, _ = read_scene(path)
    assert scene.bundles[0].path == str(folder / "part" / "a.v3dg")


def test_a_nested_scene_is_turned_to_the_axis_that_is_up(folder):
    put(folder / "b.json", {"bundle": "a", "position": [0, 0, 0], "up": "y"})
    path = put(folder / "s.json", {"scene": "b", "position": [0, 0, 0], "up": "z"}, scenes=["b"])
    scene, _ = read_scene(path)
    np.testing.assert_allclose(scene.rotations[0] @ (0, -1, 0), (0, 0, 1), atol=1e-12)
    assert scene.up == "z"


def test_cycles_are_shown(folder):
    put(folder / "a.json", {"scene": "b", "position": [0, 0, 0]}, scenes=["b"])
    put(folder / "b.json", {"scene": "c", "position": [0, 0, 0]}, scenes=["c"])
    put(folder / "c.json", {"scene": "a", "position": [0, 0, 0]}, scenes=["a"])
    message = "c.json: scenes.a: expected scenes that do not contain themselves, got a.json > "
    with pytest.raises(ValueError, match=re.escape(f"{message}b.json > c.json > a.json")):
        read_scene(folder / "a.json")


def test_depth_and_number_of_instances_are_bounded(folder):
    put(folder / "s0.json", *[{"bundle": "a", "position": [0, 0, 0]}] * 10)
    for depth in range(1, 20):
        inner = [{"scene": f"s{depth - 1}", "position": [0, 0, 0]}] * 10
        put(folder / f"s{depth}.json", *inner, scenes=[f"s{depth - 1}"])
    assert len(read_scene(folder / "s2.json")[0]) == 1000
    with pytest.raises(ValueError, match="at most 16 nested scenes"):
        read_scene(folder / "s16.json")


def test_more_instances_than_a_scene_holds_are_refused(folder, monkeypatch):
    monkeypatch.setattr(scene_file, "_MOST_INSTANCES", 15)
    put(folder / "b.json", *[{"bundle": "a", "position": [0, 0, 0]}] * 10)
    path = put(folder / "s.json", *[{"scene": "b", "position": [0, 0, 0]}] * 2, scenes=["b"])
    with pytest.raises(ValueError, match=r"s.json: instances\[1\]: expected at most 15 instances"):
        read_scene(path)


def test_missing_and_damaged_nested_scenes_are_named(folder):
    path = put(folder / "s.json", {"scene": "b", "position": [0, 0, 0]}, scenes=["b"])
    with pytest.raises(
        FileNotFoundError, match=r"s\.json: scenes\.b: expected a scene at .*b\.json"
    ):
        read_scene(path)
    (folder / "b.json").write_text("{")
    with pytest.raises(ValueError, match=r"^b\.json: expected JSON"):
        read_scene(path)
