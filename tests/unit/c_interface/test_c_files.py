"""The C library opens the same files as Python, and rejects others for the same
reasons."""

import json
import random
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

import c_library
from c_library import CScene, Failure
from fuzz.mutations import changed_json
from fuzz.targets import BUNDLES, with_fitting_hashes
from random_bundle import random_bundle
from test_bundle import join_file, split_file
from test_scene_file import GOOD, published_layout
from v3dg import Bundle, read_scene
from v3dg._json import is_one_line

pytestmark = pytest.mark.slow  # slow, because the library is compiled first
ROOT = Path(__file__).parents[3]
CORPUS = ROOT / "tests" / "fuzz" / "corpus"
GOLDEN = sorted((ROOT / "tests" / "golden").glob("*.v3dg"))
NUM_CHANGES = 300
# Only the C library rejects layouts of the paper, JSON strings with half of a surrogate
# pair, JSON numbers that overflow a double, and `false` in place of 0 in a header.
ONLY_IN_C = re.compile(
    "published with the V3DG paper|surrogate|number overflow|data_offsets.*false"
)


def python_error(read, path):
    try:
        read(path)
    except (ValueError, OSError) as error:
        return str(error)
    return None


def c_error(path):
    """Return the error message of the C library for a file, or None if it is opened."""
    failure = None
    try:
        with CScene(path):
            pass
    except Failure as error:
        failure = error
    if failure is None:
        return None
    assert failure.status in (c_library.FILE, c_library.SYSTEM)
    assert is_one_line(str(failure))
    return str(failure)


def check_same(read, path):
    """Compare both messages up to the value, whose text may differ."""
    expected = python_error(read, path)
    found = c_error(path)
    if found is not None and ONLY_IN_C.search(found):
        return
    assert (found is None) == (expected is None), (found, expected)
    if found is not None:
        assert found.partition(", got")[0] == expected.partition(", got")[0]


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the bundles that scenes of the corpus refer to."""
    (tmp_path / "sub").mkdir()
    for name, bundle in BUNDLES.items():
        bundle.write(tmp_path / "written.v3dg")
        (tmp_path / "written.v3dg").rename(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_all_versions_are_opened(path):
    bundle = Bundle.open(path)
    with CScene(path) as scene:
        info = scene.bundle_info()
        assert info.version == bundle.info()["version"]
        assert bool(info.is_quantized) == (bundle.codec == "quantized")
        rows = scene.read_gaussians(0, 0, bundle.sh_degree)
    np.testing.assert_array_equal(rows[0], bundle.read_page(0).means)


def test_bundles_of_the_corpus_are_judged_alike(tmp_path):
    path = tmp_path / "fuzz.v3dg"
    with zipfile.ZipFile(CORPUS / "bundle.zip") as archive:
        for name in archive.namelist():
            content = archive.read(name)
            for data in (content, with_fitting_hashes(content)):
                path.write_bytes(data)
                check_same(Bundle.open, path)


def test_scenes_of_the_corpus_are_judged_alike(folder):
    path = folder / "fuzz.json"
    with zipfile.ZipFile(CORPUS / "scene.zip") as archive:
        for name in archive.namelist():
            path.write_bytes(archive.read(name))
            check_same(read_scene, path)


def test_what_the_fuzzer_of_the_library_kept_is_judged_alike(folder):
    with zipfile.ZipFile(CORPUS / "c_library.zip") as archive:
        names = archive.namelist()
        assert len(names) > 100
        for name in names:
            content = archive.read(name)
            if content.startswith(b"{"):
                (folder / "fuzz.json").write_bytes(content)
                check_same(read_scene, folder / "fuzz.json")
                continue
            (folder / "fuzz.v3dg").write_bytes(with_fitting_hashes(content))
            check_same(Bundle.open, folder / "fuzz.v3dg")


def test_changed_scenes_are_judged_alike(folder):
    path = folder / "fuzz.json"
    good = json.dumps(GOOD | {"bundles": {"donut": "a.v3dg"}}).encode()
    rng = random.Random(0)
    for _ in range(NUM_CHANGES):
        path.write_bytes(changed_json(good, rng))
        check_same(read_scene, path)


@pytest.mark.parametrize("codec", ["float32", "quantized"])
def test_changed_headers_and_tables_are_judged_alike(tmp_path, codec):
    path = tmp_path / "fuzz.v3dg"
    random_bundle(3, config={"up": "z"}, codec=codec).write(path)
    header, tensors = split_file(path.read_bytes())
    text = json.dumps(header).encode()
    rng = random.Random(0)
    for _ in range(NUM_CHANGES):
        changed = {name: array.copy() for name, array in tensors.items()}
        name = rng.choice([name for name in tensors if name not in ("pages", "pages.hash")])
        is_of_header = rng.random() < 0.5
        if not is_of_header and changed[name].size:
            values = changed[name].reshape(-1)
            values[rng.randrange(values.size)] = rng.choice([0, 1, 2, 100])
        header_text = changed_json(text, rng) if is_of_header else text
        path.write_bytes(join_file(header_text, changed))
        check_same(Bundle.open, path)


def test_every_truncation_is_an_error(tmp_path):
    path = tmp_path / "cut.v3dg"
    random_bundle(1, codec="quantized").write(path)
    data = path.read_bytes()
    for size in sorted({*range(0, len(data), 97), 7, 8, len(data) - 1}):
        path.write_bytes(data[:size])
        check_same(Bundle.open, path)
        assert c_error(path) is not None


def test_damaged_pages_are_found_when_they_are_read(tmp_path):
    path = tmp_path / "damaged.v3dg"
    random_bundle(1).write(path)
    with CScene(path) as scene:
        place = scene.page_info(0)
    data = bytearray(path.read_bytes())
    data[place.offset] ^= 1
    path.write_bytes(data)
    bundle = Bundle.open(path)
    with pytest.raises(ValueError, match="page 0") as expected:
        bundle.read_page(0)
    with CScene(path) as scene:
        for read in (scene.read_page, scene.read_gaussians):
            with pytest.raises(Failure, match="page 0: the hash does not match") as failure:
                read(0)
            assert failure.value.status == c_library.FILE
    assert "the hash does not match" in str(expected.value)


def test_a_zero_byte_does_not_end_json(tmp_path):
    path = tmp_path / "scene.json"
    path.write_bytes(b'{"format": "v3dg-scene", "version": 1, "bundles": {}, "instances": []}\0x')
    assert "a zero byte is not JSON" in c_error(path)


def test_deep_json_is_refused(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text("[" * 100_000)
    assert "nested too deeply" in c_error(path)


def test_published_layouts_are_refused_with_advice(tmp_path):
    path = tmp_path / "layout.json"
    path.write_text(json.dumps(published_layout()))
    assert "convert it in Python with v3dg.read_scene and v3dg.write_scene" in c_error(path)


def test_nested_scenes_are_those_of_python(folder):
    inner = {
        "format": "v3dg-scene",
        "version": 1,
        "up": "y",
        "bundles": {"a": "../a.v3dg", "b": "b.v3dg"},
        "instances": [
            {"bundle": "b", "position": [1, 2, 3], "tint": [0.5, 1, 2], "up": "y"},
            {"bundle": "a", "position": [0, 1, 0], "scale": 3, "importance": 2, "environment": 4},
        ],
    }
    turn = [[0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]]
    outer = {
        "format": "v3dg-scene",
        "version": 1,
        "scenes": {"block": "sub/block.json"},
        "bundles": {"a": "a.v3dg"},
        "instances": [
            {"bundle": "a", "position": [9, 0, 0], "quaternion": [1, 2, 3, 4], "opacity": 0.25},
            {"scene": "block", "matrix": turn, "up": "-x", "opacity": 0.5},
            {"scene": "block", "position": [-4, 0, 0], "environment": 9},
        ],
        "cameras": GOOD["cameras"],
    }
    (folder / "sub" / "block.json").write_text(json.dumps(inner))
    path = folder / "outer.json"
    path.write_text(json.dumps(outer))
    scene, cameras = read_scene(path)
    with CScene(path) as c_scene:
        instances = c_scene.instances()
        assert len(instances) == len(scene) == 5
        assert [i.bundle for i in instances] == scene.instance_bundle.tolist()
        for name, expected in [
            ("position", scene.positions),
            ("quaternion", scene.quaternions),
            ("scale", scene.scales),
            ("importance", scene.importance),
            ("opacity", scene.opacity),
            ("tint", scene.tint),
            ("environment", scene.environments),
        ]:
            found = np.array([np.array(getattr(i, name)) for i in instances])
            np.testing.assert_allclose(found, expected, atol=1e-14, err_msg=name)
        for index, (name, camera) in enumerate(cameras.items()):
            found_name, found_camera = c_scene.camera(index)
            assert found_name == name
            found = np.array(found_camera.viewmat).reshape(4, 4)
            np.testing.assert_allclose(found, camera.viewmat, atol=1e-15)
            assert (found_camera.width, found_camera.height) == (camera.width, camera.height)
            np.testing.assert_allclose([found_camera.fx, found_camera.cy], [camera.fx, camera.cy])


def test_scenes_that_contain_themselves_are_refused(folder):
    document = GOOD | {"scenes": {"me": "loop.json"}, "bundles": {"donut": "a.v3dg"}}
    path = folder / "loop.json"
    path.write_text(json.dumps(document))
    check_same(read_scene, path)
    assert "loop.json > loop.json" in c_error(path)


def test_random_similarities_are_decomposed_as_in_python(folder):
    rng = np.random.default_rng(0)
    instances = []
    for _ in range(50):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        matrix = np.eye(4)
        matrix[:3, :3] = np.exp(rng.uniform(-20, 20)) * rotation
        matrix[:3, :3] += 1e-5 * np.abs(matrix[:3, :3]).max() * rng.uniform(-1, 1, (3, 3))
        matrix[:3, 3] = rng.normal(size=3)
        instances.append({"bundle": "donut", "matrix": matrix.tolist()})
    path = folder / "matrices.json"
    document = GOOD | {"instances": instances, "bundles": {"donut": "a.v3dg"}}
    path.write_text(json.dumps(document))
    scene, _ = read_scene(path)
    with CScene(path) as c_scene:
        found = c_scene.instances()
    np.testing.assert_allclose([list(i.quaternion) for i in found], scene.quaternions, atol=1e-12)
    np.testing.assert_allclose([i.scale for i in found], scene.scales, rtol=1e-12)


@pytest.mark.parametrize(
    ("linear", "kind"),
    [
        (np.diag([1.0, 1, -1]), "a reflection"),
        (np.diag([1.0, 2, 1]), "different scales: 1 2 1"),
        (np.diag([1.0, 0, 1]), "a scale of 0 along an axis"),
        (np.zeros((3, 3)), "a scale of 0"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "a shear"),
    ],
)
def test_other_matrices_are_refused_by_kind(folder, linear, kind):
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    path = folder / "matrix.json"
    instances = [{"bundle": "donut", "matrix": matrix.tolist()}]
    document = GOOD | {"instances": instances, "bundles": {"donut": "a.v3dg"}}
    path.write_text(json.dumps(document))
    assert f"got {kind};" in c_error(path)
    assert c_error(path) == python_error(read_scene, path)
