"""Reading glTF: where nodes place gaussians, and every form in which the specification
stores numbers. Values are compared in the axes of the file, before the reader rotates
them.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import v3dg
from gltf_files import FLOAT, NAME, GltfFile, glb_bytes
from random_bundle import random_gaussians
from v3dg import Gaussians
from v3dg._core import sh_bases
from v3dg.cleaning import AssetWarning
from v3dg.formats import _axes, gltf, spz
from v3dg.formats._gltf_document import Document
from v3dg.formats._gltf_scene import Scene
from v3dg.io import asset_bytes, open_asset
from v3dg.rotations import normalised, rotation_from_quaternion

SH_C0 = 0.28209479177387814
ASSET = random_gaussians(np.random.default_rng(0), 20, 2)
OTHER = random_gaussians(np.random.default_rng(1), 7, 2)
COS = float(np.cos(0.4))
SIN = float(np.sin(0.4))


def read(path):
    """Return the gaussians in the axes of glTF, as they are in the file."""
    return Scene(Document(path)).read()


def notes_of(path):
    return list(open_asset(path).declared.notes)


def assert_same(found, wanted, atol=2e-6):
    assert len(found) == len(wanted)
    assert found.sh_degree == wanted.sh_degree
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=atol, err_msg=name
        )
    sign = np.sign((found.quats * wanted.quats).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(found.quats * sign, normalised(wanted.quats), atol=2e-6)


def with_sh(gaussians, sh):
    return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh)


def padded(gaussians, degree):
    sh = np.zeros((len(gaussians), (degree + 1) ** 2, 3), np.float32)
    sh[:, : gaussians.sh.shape[1]] = gaussians.sh
    return with_sh(gaussians, sh)


def about(axis, angle):
    """Return a quaternion x y z w, in the order of glTF."""
    return [*(np.sin(angle / 2) * np.eye(3)["xyz".index(axis)]), np.cos(angle / 2)]


def matrix_of(quaternion=(0, 0, 0, 1), translation=(0, 0, 0), scale=(1, 1, 1)):
    """Return the columns of a matrix one after the other."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion(np.roll(quaternion, 1)) * scale
    matrix[:3, 3] = translation
    return matrix.T.ravel().tolist()


def test_a_node_without_a_transform_changes_no_bit(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET), "translation": [0, 0, 0], "scale": [1, 1, 1]})
    found = read(file.write(tmp_path / "a.glb"))
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ASSET, name))


TURN = about("x", 1.0)
NODES = {
    "translation": ({"translation": [1, 2, 3]}, ((1, 0, 0, 0), (1, 2, 3), 1)),
    "rotation": ({"rotation": TURN}, (np.roll(TURN, 1), (0, 0, 0), 1)),
    "scale": ({"scale": [2, 2, 2]}, ((1, 0, 0, 0), (0, 0, 0), 2)),
    "all": (
        {"translation": [1, 2, 3], "rotation": TURN, "scale": [0.5, 0.5, 0.5]},
        (np.roll(TURN, 1), (1, 2, 3), 0.5),
    ),
    "matrix": (
        {"matrix": matrix_of(TURN, (1, 2, 3), (3, 3, 3))},
        (np.roll(TURN, 1), (1, 2, 3), 3),
    ),
    "two mirrors": ({"scale": [-2, -2, 2]}, ((0, 0, 0, 1), (0, 0, 0), 2)),
    "a quaternion that is not of length 1": (
        {"rotation": [10 * x for x in TURN]},
        (np.roll(TURN, 1), (0, 0, 0), 1),
    ),
}


@pytest.mark.parametrize("case", NODES)
def test_gaussians_stand_where_their_node_puts_them(tmp_path, case):
    fields, similarity = NODES[case]
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET), **fields})
    assert_same(read(file.write(tmp_path / "a.glb")), ASSET.transform(*similarity))


def test_transforms_of_parents_come_after_those_of_children(tmp_path):
    file = GltfFile()
    file.nodes(
        {"children": [2], "translation": [1, 2, 3], "scale": [2, 2, 2]},
        {"camera": 0, "translation": [9, 9, 9]},
        {"children": [1, 3], "rotation": TURN},
        {"mesh": file.mesh(ASSET), "matrix": matrix_of(about("z", 2.0), (4, 5, 6), (3, 3, 3))},
    )
    inner = ASSET.transform(np.roll(about("z", 2.0), 1), (4, 5, 6), 3)
    wanted = inner.transform(np.roll(TURN, 1)).transform(position=(1, 2, 3), scale=2)
    assert_same(read(file.write(tmp_path / "a.glb")), wanted, atol=2e-5)


def test_a_mesh_is_read_wherever_it_is_used(tmp_path):
    """All primitives of a mesh are read; they may have different degrees."""
    flat = with_sh(OTHER, np.ascontiguousarray(OTHER.sh[:, :1]))
    file = GltfFile()
    mesh = file.mesh(ASSET, flat)
    file.document["meshes"][mesh]["primitives"].append({"attributes": {}})  # triangles
    file.nodes(
        {"children": [1, 2]},
        {"mesh": mesh},
        {"mesh": mesh, "translation": [5, 0, 0]},
        {"mesh": mesh, "translation": [0, 0, 9]},
    )
    both = Gaussians.concatenate([ASSET, padded(flat, 2)])
    wanted = Gaussians.concatenate([both, both.transform(position=(5, 0, 0))])
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), wanted)
    assert open_asset(path).num_gaussians == 54


def test_scales_along_axes_stretch_gaussians(tmp_path):
    """As the extension defines, the matrix transforms the covariance, but colours are
    only rotated by its rotation."""
    factors = np.array([0.5, 2.0, 3.0])
    file = GltfFile()
    file.nodes(
        {"mesh": file.mesh(ASSET), "rotation": TURN, "scale": factors.tolist()},
    )
    found = read(file.write(tmp_path / "a.glb"))
    rotation = rotation_from_quaternion(np.roll(TURN, 1))
    matrix = rotation * factors
    np.testing.assert_allclose(found.means, ASSET.means @ matrix.T, atol=1e-5)
    covariance = covariances(ASSET)
    np.testing.assert_allclose(covariances(found), matrix @ covariance @ matrix.T, atol=1e-6)
    np.testing.assert_allclose(found.sh, ASSET.transform(np.roll(TURN, 1)).sh, atol=1e-5)
    np.testing.assert_array_equal(found.opacities, ASSET.opacities)


def covariances(gaussians):
    axes = rotation_from_quaternion(normalised(gaussians.quats)) * gaussians.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def test_gaussians_that_are_not_finite_are_passed_on_by_a_stretch(tmp_path):
    means = ASSET.means.copy()
    scales = ASSET.scales.copy()
    means[0] = np.nan
    scales[1] = np.inf
    broken = Gaussians(means, ASSET.quats, scales, ASSET.opacities, ASSET.sh)
    file = GltfFile()
    file.nodes({"mesh": file.mesh(broken), "scale": [1, 2, 3]})
    found = read(file.write(tmp_path / "a.glb"))
    assert np.isnan(found.means[0]).all()
    assert not np.isfinite(found.scales[1]).any()
    assert np.isfinite(found.scales[2:]).all()


WRONG_NODES = {
    "a reflection": ([{"mesh": 0, "scale": [-1, 1, 1]}], "nodes[0]: expected a rotation"),
    "a reflection below": (
        [{"children": [1], "scale": [1, 1, -1]}, {"mesh": 0}],
        "nodes[1]: expected a rotation, a translation and positive scales, got a reflection",
    ),
    "a shear": (
        [{"children": [1], "scale": [1, 5, 1]}, {"mesh": 0, "rotation": about("x", 0.7)}],
        "nodes[1]: expected a rotation, a translation and positive scales, got a shear",
    ),
    "no size": ([{"mesh": 0, "scale": [0, 0, 0]}], "got a scale of 0"),
    "flat": ([{"mesh": 0, "scale": [1, 0, 1]}], "got a scale of 0"),
    "too large": (
        [{"children": [1], "scale": [1e300] * 3}, {"mesh": 0, "scale": [1e300] * 3}],
        "nodes[1]: expected a rotation",
    ),
    "a quaternion of zeros": (
        [{"mesh": 0, "rotation": [0, 0, 0, 0]}],
        "nodes[0].rotation: expected a quaternion of length 1",
    ),
    "another last row": (
        [{"mesh": 0, "matrix": [1, 0, 0, 1, *matrix_of()[4:]]}],
        "nodes[0]: expected a matrix with the last row 0 0 0 1",
    ),
    "15 numbers": ([{"mesh": 0, "matrix": matrix_of()[1:]}], "nodes[0].matrix: expected 16"),
    "both": (
        [{"mesh": 0, "matrix": matrix_of(), "scale": [1, 1, 1]}],
        "nodes[0]: expected a matrix or scale, got both",
    ),
    "a cycle": (
        [{"mesh": 0, "children": [1]}, {"children": [0]}],
        "nodes[0]: expected at most one parent and no cycle",
    ),
    "itself": ([{"mesh": 0, "children": [0]}], "nodes[0]: expected at most one parent"),
    "two parents": (
        [{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}],
        "nodes[2]: expected at most one parent",
    ),
    "no such node": ([{"mesh": 0, "children": [7]}], "nodes[0].children[0]: expected 0 to 0"),
    "no such mesh": ([{"mesh": 1}], "nodes[0].mesh: expected 0 to 0, got 1"),
    "instances": (
        [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}],
        "nodes[0]: expected one mesh, got EXT_mesh_gpu_instancing",
    ),
}


@pytest.mark.parametrize("case", WRONG_NODES)
def test_transforms_that_are_none_are_refused_by_name(tmp_path, case):
    nodes, message = WRONG_NODES[case]
    file = GltfFile()
    file.mesh(ASSET)
    file.nodes(*nodes)
    with pytest.raises(ValueError, match=r"a\.glb: ") as error:
        v3dg.read_asset(file.write(tmp_path / "a.glb"))
    assert message in str(error.value)


def test_the_scene_that_is_shown_is_read(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)}, {"mesh": file.mesh(OTHER)})
    file.document["scenes"] = [{"nodes": [0]}, {"nodes": [1], "name": "other"}]
    path = tmp_path / "a.glb"
    file.document["scene"] = 1
    assert_same(read(file.write(path)), OTHER)
    left_out = "1 meshes with gaussians are ignored, because no node of the scene has them."
    assert notes_of(path) == ["Scene 1 of 2 (other) is read, and the others are ignored.", left_out]
    del file.document["scene"]
    assert_same(read(file.write(path)), ASSET)
    assert notes_of(path)[0] == "Scene 0 of 2 is read, and the others are ignored."
    file.document["scenes"][0]["nodes"] = []
    file.write(path)
    with pytest.raises(ValueError, match="got none in the scene that is shown; 2 meshes outside"):
        v3dg.read_asset(path)
    file.document["scene"] = 2
    file.write(path)
    with pytest.raises(ValueError, match="scene: expected 0 to 1, got 2"):
        v3dg.read_asset(path)


def test_without_scenes_all_nodes_are_read_and_without_nodes_all_meshes(tmp_path):
    file = GltfFile()
    file.mesh(ASSET)
    path = tmp_path / "a.glb"
    assert_same(read(file.write(path)), ASSET)
    file.document["nodes"] = [
        {"mesh": 0, "translation": [1, 0, 0]},
        {"children": [0], "translation": [0, 1, 0]},
    ]
    assert_same(read(file.write(path)), ASSET.transform(position=(1, 1, 0)))


def quantised(values, kind, is_normalised):
    """Return values from 0 to 1, or -1 to 1, as integers, and the values that these
    encode."""
    most = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}[kind]
    numbers = np.rint(np.asarray(values) * most)
    if is_normalised:
        return numbers, np.maximum(numbers / most, -1)
    return numbers, numbers


NUMBERS = {
    "POSITION": [(kind, flag) for kind in (5120, 5121, 5122, 5123) for flag in (True, False)],
    "SCALE": [(5121, True), (5121, False), (5123, True), (5123, False)],
    "ROTATION": [(5120, True), (5122, True)],
    "OPACITY": [(5121, True), (5123, True)],
}


@pytest.mark.parametrize(
    ("name", "kind", "is_normalised"),
    [(name, *how) for name, kinds in NUMBERS.items() for how in kinds],
)
def test_whole_numbers_stand_for_what_the_specification_says(tmp_path, name, kind, is_normalised):
    values = {
        "POSITION": np.clip(np.abs(ASSET.means) / 4, 0, 1),
        "SCALE": ASSET.scales,
        "ROTATION": np.roll(ASSET.quats, -1, axis=1),
        "OPACITY": ASSET.opacities[:, None],
    }[name]
    numbers, wanted = quantised(values, kind, is_normalised)
    file = GltfFile()
    attributes = file.attributes(ASSET)
    key = name if name == "POSITION" else f"{NAME}:{name}"
    attributes[key] = file.accessor(numbers, kind, normalized=is_normalised)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    found = read(file.write(tmp_path / "a.glb"))
    if name == "ROTATION":
        unit = normalised(np.roll(wanted, 1, axis=1))
        np.testing.assert_allclose(found.quats, unit, atol=1e-6)
        return
    columns = {"POSITION": found.means, "SCALE": found.scales, "OPACITY": found.opacities[:, None]}
    np.testing.assert_allclose(columns[name], wanted, rtol=1e-6)


def test_the_lowest_whole_number_is_minus_one(tmp_path):
    file = GltfFile()
    attributes = file.attributes(ASSET)
    numbers = np.full((20, 3), -128)
    attributes["POSITION"] = file.accessor(numbers, 5120, normalized=True)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    np.testing.assert_array_equal(read(file.write(tmp_path / "a.glb")).means, -1)


def sparse(file, rows, places, values, kind=5123, **fields):
    """Return the index of an accessor of zeros or of a view, with some values
    replaced."""
    numbers = np.asarray(places).astype({5121: "u1", 5123: "<u2", 5125: "<u4"}[kind])
    part = {
        "count": len(places),
        "indices": {"bufferView": file.view(numbers.tobytes()), "componentType": kind},
        "values": {"bufferView": file.view(np.asarray(values, "<f4").tobytes())},
    }
    return file.bare_accessor(rows, sparse=part, **fields)


@pytest.mark.parametrize("kind", [5121, 5123, 5125])
def test_sparse_accessors_replace_some_values(tmp_path, kind):
    file = GltfFile()
    attributes = file.attributes(ASSET)
    base = file.document["accessors"][attributes["POSITION"]]["bufferView"]
    values = OTHER.means[:3]
    places = [0, 5, 19]
    attributes["POSITION"] = sparse(file, ASSET.means, places, values, kind, bufferView=base)
    scale = ASSET.scales[:2]
    attributes[f"{NAME}:SCALE"] = sparse(file, ASSET.scales, [3, 4], scale, kind)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    found = read(file.write(tmp_path / "a.glb"))
    means = ASSET.means.copy()
    means[places] = values
    np.testing.assert_array_equal(found.means, means)
    scales = np.zeros_like(ASSET.scales)
    scales[[3, 4]] = scale
    np.testing.assert_array_equal(found.scales, scales)


def test_an_accessor_without_a_view_is_zeros(tmp_path):
    file = GltfFile()
    attributes = file.attributes(ASSET)
    attributes["POSITION"] = file.bare_accessor(ASSET.means)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    found = read(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(found.means, 0)
    np.testing.assert_array_equal(found.scales, ASSET.scales)


WRONG_SPARSE = {
    "too many": (lambda s, a: s.update(count=21), "sparse.count: expected 1 to 20, got 21"),
    "far too many": (lambda s, a: s.update(count=1 << 40), "sparse.count: expected 1 to 20"),
    "none": (lambda s, a: s.update(count=0), "sparse.count: expected 1 to 20, got 0"),
    "beyond": (lambda s, a: a.update(count=19), "count: expected 20, as POSITION has, got 19"),
    "backwards": (
        lambda s, a: s["indices"].update(byteOffset=2),
        "sparse.indices: expected ascending indices below 20, got others",
    ),
    "signed": (lambda s, a: s["indices"].update(componentType=5122), "expected one of 5121, 5123"),
    "short values": (
        lambda s, a: s["values"].update(byteOffset=4),
        "sparse.values: expected 3 elements in its buffer view, got one of 36 bytes",
    ),
}


@pytest.mark.parametrize("case", WRONG_SPARSE)
def test_wrong_sparse_accessors_are_refused(tmp_path, case):
    change, message = WRONG_SPARSE[case]
    file = GltfFile()
    attributes = file.attributes(ASSET)
    places = [1, 5, 7, 3]
    number = sparse(file, ASSET.scales, places, np.zeros((3, 3)))
    attributes[f"{NAME}:SCALE"] = number
    accessor = file.document["accessors"][number]
    accessor["sparse"]["count"] = 3
    change(accessor["sparse"], accessor)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    path = file.write(tmp_path / "a.glb")
    with pytest.raises(ValueError, match=r"a\.glb: ") as error:
        v3dg.read_asset(path)
    assert message in str(error.value)


def test_values_that_are_interleaved_are_read(tmp_path):
    """A view contains several attributes, each with its offset."""
    file = GltfFile()
    attributes = file.attributes(ASSET)
    rows = np.concatenate([ASSET.means, ASSET.scales, np.zeros((20, 2))], axis=1).astype("<f4")
    view = file.view(bytes(8) + rows.tobytes(), byteStride=32)
    attributes["POSITION"] = file.bare_accessor(ASSET.means, bufferView=view, byteOffset=8)
    attributes[f"{NAME}:SCALE"] = file.bare_accessor(ASSET.scales, bufferView=view, byteOffset=20)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    assert_same(read(file.write(tmp_path / "a.glb")), ASSET)


@pytest.mark.parametrize("kind", [5121, 5123, 5125])
def test_indices_choose_vertices(tmp_path, kind):
    file = GltfFile()
    primitive = file.primitive(file.attributes(ASSET))
    primitive["indices"] = file.accessor(np.array([7, 3, 3]), kind)
    file.nodes({"mesh": file.mesh(primitive)})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), ASSET.subset([7, 3, 3]))
    assert open_asset(path).num_gaussians == 3
    primitive["indices"] = file.accessor(np.array([20]), kind)
    with pytest.raises(ValueError, match="expected indices below 20, got 20"):
        v3dg.read_asset(file.write(path))


URIS = ["a.bin", "b c.bin", "b%20c.bin", "parts/a.bin", "./parts/a.bin", "k%C3%A4se.bin"]


@pytest.mark.parametrize("uri", URIS)
def test_buffers_are_files_beside_the_document(tmp_path, uri):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    name = {"b%20c.bin": "b c.bin", "k%C3%A4se.bin": "käse.bin"}.get(uri, uri)
    (tmp_path / "parts").mkdir()
    (tmp_path / name).write_bytes(file.blob)
    path = file.write(tmp_path / "a.gltf", uri)
    assert_same(read(path), ASSET)
    assert len(v3dg.read_asset(path)) == len(ASSET)
    assert asset_bytes(path) == path.stat().st_size + len(file.blob)
    (tmp_path / name).write_bytes(file.blob[:-1])
    with pytest.raises(ValueError, match="byteLength: expected at most"):
        v3dg.read_asset(path)
    (tmp_path / name).unlink()
    with pytest.raises(FileNotFoundError, match=os.path.basename(name)):
        v3dg.read_asset(path)


ESCAPES = [
    *("../a.bin", "/etc/hostname", "parts/../../a.bin", "%2e%2e/a.bin", "parts//a.bin"),
    *("..\\a.bin", "C:\\a.bin", "file:///etc/hostname", "https://example.com/a.bin"),
    *("//example.com/a.bin", "a.bin?x", "a.bin#x", "a%00.bin", "a%0a.bin", "%2Fetc%2Fhostname"),
]


@pytest.mark.parametrize("uri", ESCAPES)
def test_nothing_outside_of_the_folder_is_read(tmp_path, uri):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    folder = tmp_path / "folder"
    (folder / "parts").mkdir(parents=True)
    (tmp_path / "a.bin").write_bytes(file.blob)
    path = file.write(folder / "a.gltf", uri)
    with pytest.raises(ValueError, match=r"buffers.0..uri: expected a (relative )?path .*, got"):
        v3dg.read_asset(path)


def test_a_document_may_have_its_buffers_inside(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    path = file.write(tmp_path / "a.gltf")
    assert_same(read(path), ASSET)
    for uri in ("data:application/octet-stream;base64,!", "data:text/plain,abc", "data:"):
        file.write(path, uri)
        with pytest.raises(ValueError, match=r"buffers\[0\].uri: expected .*data in base64"):
            v3dg.read_asset(path)


def test_a_glb_may_have_several_buffers(tmp_path):
    """The first buffer is the chunk in the file. The others are files or data URIs."""
    file = GltfFile()
    attributes = file.attributes(ASSET)
    view = file.document["bufferViews"][file.document["accessors"][0]["bufferView"]]
    first = view["byteOffset"]
    (tmp_path / "a.bin").write_bytes(file.blob[first : first + view["byteLength"]])
    view.update(buffer=1, byteOffset=0)
    file.blob[first : first + view["byteLength"]] = bytes(view["byteLength"])
    file.document["buffers"].append({"byteLength": view["byteLength"], "uri": "a.bin"})
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), ASSET)
    del file.document["buffers"][1]["uri"]
    with pytest.raises(ValueError, match=r"buffers\[1\]: expected a uri, got a buffer without"):
        v3dg.read_asset(file.write(path))


def test_extensions_that_must_be_read_are_named(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    path = tmp_path / "a.glb"
    file.document["extensionsUsed"] += ["KHR_materials_unlit", "EXT_a", "KHR_mesh_quantization"]
    file.document["extensionsRequired"] = ["KHR_materials_unlit", NAME, "KHR_mesh_quantization"]
    file.document["animations"] = [{}]
    file.write(path)
    animations = "Animations are not read: nodes keep their rest poses."
    assert notes_of(path) == ["The extension EXT_a is not read.", animations]
    for name in ("EXT_meshopt_compression", "KHR_draco_mesh_compression", "EXT_a"):
        file.document["extensionsRequired"] = [NAME, name]
        file.write(path)
        expected = (
            f"extensionsRequired.1.: expected required extensions .* supports, got {name}; write"
        )
        with pytest.raises(ValueError, match=expected):
            v3dg.read_asset(path)


def test_bytes_that_another_extension_packs_are_refused(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    name = "EXT_meshopt_compression"
    path = tmp_path / "a.glb"
    file.document["buffers"].append({"byteLength": 99, "extensions": {name: {"fallback": True}}})
    view = file.document["bufferViews"][0]
    view["extensions"] = {name: {"buffer": 0, "byteLength": view["byteLength"]}}
    assert_same(read(file.write(path)), ASSET)  # the fallback can be read
    view["buffer"] = 1
    file.write(path)
    with pytest.raises(ValueError, match=f"bufferViews.0.: expected uncompressed data, got {name}"):
        v3dg.read_asset(path)


@pytest.mark.parametrize("place", ["primitive", "extension"])
def test_numbers_that_another_extension_has_are_refused(tmp_path, place):
    """The accessors of compressed numbers have no view, so they would be read as
    zeros."""
    file = GltfFile()
    attributes = file.attributes(ASSET)
    primitive = file.primitive(attributes)
    holder = primitive if place == "primitive" else primitive["extensions"][NAME]
    holder.setdefault("extensions", {})["EXT_b"] = {"bufferView": 0}
    file.nodes({"mesh": file.mesh(primitive)})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), ASSET)
    attributes["POSITION"] = file.bare_accessor(ASSET.means)
    file.write(path)
    with pytest.raises(
        ValueError,
        match="expected data in a buffer, got data in EXT_b, which this reader does not support",
    ):
        v3dg.read_asset(path)


def test_what_is_declared_and_not_done_is_told(tmp_path):
    file = GltfFile()
    attributes = {**file.attributes(ASSET), "_TEMPERATURE": file.accessor(ASSET.opacities)}
    primitive = file.primitive(
        attributes,
        kernel="box",
        projection="fisheye",
        sortingMethod="cameraDistance",
        quantizedPositionScale=2,
    )
    file.nodes({"mesh": file.mesh(primitive)})
    path = file.write(tmp_path / "a.glb")
    assert notes_of(path) == [
        f"{NAME} has kernel box, which is read as ellipse.",
        f"{NAME} has projection fisheye, which is read as perspective.",
        f"quantizedPositionScale of {NAME} is not read.",
        "The attribute _TEMPERATURE is not read.",
    ]
    assert_same(read(path), ASSET)
    primitive["extensions"][NAME]["kernel"] = 3
    with pytest.raises(ValueError, match="kernel: expected a string, got 3"):
        v3dg.read_asset(file.write(path))


def test_linear_colours_are_converted(tmp_path):
    """Colours in all directions are encoded in sRGB, like the colours of a picture."""
    rng = np.random.default_rng(3)
    sh = rng.normal(0, 0.05, ASSET.sh.shape).astype(np.float32)
    sh[:, 0] = rng.uniform(-0.5, 1.5, (20, 3))
    asset = with_sh(ASSET, sh)
    file = GltfFile()
    linear = file.primitive(file.attributes(asset), colorSpace="lin_rec709_display")
    file.nodes({"mesh": file.mesh(linear)})
    path = file.write(tmp_path / "a.glb")
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    bases = sh_bases(2, directions)
    light = np.maximum(np.einsum("dk,nkc->ndc", bases, asset.sh) + 0.5, 0)
    wanted = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    colors = np.einsum("dk,nkc->ndc", bases, read(path).sh) + 0.5
    assert np.abs(colors - wanted).mean() < 0.002
    assert np.abs(colors - wanted).max() < 0.1
    # the asset is bright enough to make a difference
    assert np.abs(light - wanted).mean() > 0.1
    assert "converted to sRGB" in notes_of(path)[0]


def test_names_of_drafts_are_read(tmp_path):
    file = GltfFile()
    primitive = file.primitive(file.attributes(ASSET, prefix="_"))
    primitive["extensions"] = {NAME: {}}
    file.nodes({"mesh": file.mesh(primitive)})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), ASSET)
    assert notes_of(path) == []


@pytest.mark.parametrize("kind", [5121, FLOAT])
def test_colours_of_drafts_are_read(tmp_path, kind):
    """Drafts of the extension store colour and opacity as COLOR_0."""
    rng = np.random.default_rng(4)
    rgba = np.rint(rng.uniform(0, 255, (20, 4)))
    file = GltfFile()
    attributes = file.attributes(ASSET)
    del attributes[f"{NAME}:OPACITY"]
    del attributes[f"{NAME}:SH_DEGREE_0_COEF_0"]
    if kind == FLOAT:
        attributes["COLOR_0"] = file.accessor(rgba / 255)
    else:
        attributes["COLOR_0"] = file.accessor(rgba, kind, normalized=True)
    file.nodes({"mesh": file.mesh(file.primitive(attributes))})
    found = read(file.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(found.opacities, rgba[:, 3] / 255, atol=1e-6)
    np.testing.assert_allclose(found.sh[:, 0] * SH_C0 + 0.5, rgba[:, :3] / 255, atol=1e-6)
    np.testing.assert_array_equal(found.sh[:, 1:], ASSET.sh[:, 1:])
    attributes["COLOR_0"] = file.accessor(rgba[:, :3] / 255)
    with pytest.raises(ValueError, match="type: expected VEC4, got"):
        v3dg.read_asset(file.write(tmp_path / "a.glb"))
    del attributes["COLOR_0"]
    with pytest.raises(ValueError, match=f"expected the field {NAME}:SH_DEGREE_0_COEF_0"):
        v3dg.read_asset(file.write(tmp_path / "a.glb"))


def packed(file, asset, name):
    """Return a primitive whose gaussians are stored as `.spz`, and the name of the
    extension."""
    content = b"".join(spz.encode(asset, 2))
    attributes = {"POSITION": file.bare_accessor(asset.means)}
    extension = {"bufferView": file.view(content)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {name: extension}}
    if name != "KHR_spz_gaussian_splats_compression":
        primitive["extensions"] = {NAME: {"extensions": {name: extension}}}
    file.document["extensionsUsed"].append(name)
    file.document["extensionsRequired"] = [name]
    return primitive


SPZ_NAMES = [
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
]


@pytest.mark.parametrize("name", SPZ_NAMES)
def test_spz_in_a_primitive_is_read(tmp_path, name):
    (tmp_path / "a.spz").write_bytes(b"".join(spz.encode(ASSET, 2)))
    content = (tmp_path / "a.spz").read_bytes()
    alone = spz.decode(tmp_path / "a.spz", content, claims_of(tmp_path), "LUF", "LUF")
    file = GltfFile()
    primitive = packed(file, ASSET, name)
    file.nodes({"mesh": file.mesh(primitive), "translation": [1, 2, 3]})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), alone.transform(position=(1, 2, 3)))
    opened = open_asset(path)
    assert (opened.num_gaussians, opened.sh_degree) == (20, 2)
    assert notes_of(path) == []
    file.document["accessors"][primitive["attributes"]["POSITION"]]["count"] = 19
    with pytest.raises(ValueError, match=r"count: expected 20, as the \.spz has, got 19"):
        v3dg.read_asset(file.write(path))
    del primitive["attributes"]
    assert len(read(file.write(path))) == 20


@pytest.mark.parametrize("axes", ["", "RUB", "LUF", "RDF", "RBU"])
@pytest.mark.parametrize("released", [True, False])
def test_the_axes_of_a_spz_in_a_primitive(tmp_path, axes, released):
    """If the `.spz` records its axes, they are used. Otherwise the axes are those of
    .spz if the primitive has the properties that the released extension requires, and
    those of glTF in drafts."""
    content = b"".join(spz.encode(ASSET, 3, axes=axes))
    stored = spz.decode(tmp_path, b"".join(spz.encode(ASSET, 3)), claims_of(tmp_path), "LUF", "LUF")
    file = GltfFile()
    extension = {"extensions": {SPZ_NAMES[0]: {"bufferView": file.view(content)}}}
    if released:
        extension |= {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    attributes = {"POSITION": file.bare_accessor(ASSET.means)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {NAME: extension}}
    file.document["extensionsUsed"].append(SPZ_NAMES[0])
    file.nodes({"mesh": file.mesh(primitive)})
    path = file.write(tmp_path / "a.glb")
    source = axes or {True: "RUB", False: "LUF"}[released]
    assert_same(read(path), _axes.turned(stored, source, "LUF"))
    turned = [note for note in notes_of(path) if "CesiumJS does not turn it" in note]
    assert len(turned) == released


def test_what_is_written_for_cesium_reads_back_as_it_stands(tmp_path):
    content = gltf.encode(ASSET, compressed=True)
    (tmp_path / "a.glb").write_bytes(content)
    found = read(tmp_path / "a.glb")
    np.testing.assert_allclose(found.means, ASSET.means, atol=1e-3)
    assert notes_of(tmp_path / "a.glb") == []


def test_a_placement_where_float32_is_coarse_is_told(tmp_path):
    file = GltfFile()
    mesh = file.mesh(ASSET)
    file.nodes({"mesh": mesh, "translation": [4.2e6, 1.1e6, -4.7e6]})
    path = file.write(tmp_path / "a.glb")
    with pytest.warns(AssetWarning, match=r"a\.glb: Positions are rounded to steps of up to 0\.5"):
        v3dg.read_asset(path)


def claims_of(folder):
    return Document(GltfFile().write(folder / "empty.glb")).claims


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_antialiasing_is_kept(tmp_path, antialiased):
    path = tmp_path / "a.glb"
    v3dg.write_asset(path, ASSET.trained(antialiased=antialiased))
    assert open_asset(path).declared.antialiased is antialiased
    assert v3dg.read_asset(path).antialiased is antialiased


@pytest.mark.parametrize("antialiased", [True, False])
def test_a_spz_in_a_primitive_says_whether_it_is_antialiased(tmp_path, antialiased):
    file = GltfFile()
    parts = [packed(file, ASSET.trained(antialiased=antialiased), SPZ_NAMES[0])]
    file.nodes({"mesh": file.mesh(*parts)})
    path = tmp_path / "a.glb"
    assert open_asset(file.write(path)).declared.antialiased is antialiased
    parts.append(packed(file, OTHER.trained(antialiased=not antialiased), SPZ_NAMES[0]))
    file.nodes({"mesh": file.mesh(*parts)})
    assert open_asset(file.write(path)).declared.antialiased is None


VERSIONS = [
    ({"version": "1.0"}, 'asset.version: expected glTF 2.0, got "1.0"'),
    ({"version": "2.1", "minVersion": "2.1"}, 'asset.minVersion: expected glTF 2.0, got "2.1"'),
]


@pytest.mark.parametrize(("asset", "message"), VERSIONS)
def test_other_versions_are_refused(tmp_path, asset, message):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    file.document["asset"] = asset
    with pytest.raises(ValueError, match=message):
        v3dg.read_asset(file.write(tmp_path / "a.glb"))
    file.document["asset"] = {"version": "2.1", "minVersion": "2.0"}
    assert len(v3dg.read_asset(file.write(tmp_path / "a.glb"))) == 20


def test_chunks_of_others_are_passed_over(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    content = bytearray(file.write(tmp_path / "a.glb").read_bytes())
    content += (8).to_bytes(4, "little") + b"XXXX" + bytes(8)
    content[8:12] = len(content).to_bytes(4, "little")
    (tmp_path / "a.glb").write_bytes(content)
    assert_same(read(tmp_path / "a.glb"), ASSET)


def test_nodes_may_be_nested_deep(tmp_path):
    """The nodes are nested far deeper than Python's stack.

    Reading takes the time of one pass.
    """
    file = GltfFile()
    mesh = file.mesh(ASSET)
    count = 30_000
    nodes = [{"children": [i + 1]} for i in range(count)]
    nodes[0]["translation"] = [1, 0, 0]
    file.nodes(*nodes, {"mesh": mesh})
    path = file.write(tmp_path / "a.glb")
    assert_same(read(path), ASSET.transform(position=(1, 0, 0)))


def test_a_mesh_that_is_used_too_often_is_refused(tmp_path):
    """Every use of a mesh by a node counts. The file's size bounds the number of
    gaussians."""
    file = GltfFile()
    mesh = file.mesh(random_gaussians(np.random.default_rng(0), 100))
    file.nodes(*[{"mesh": mesh}] * 20_000, roots=range(20_000))
    path = file.write(tmp_path / "a.glb")
    with pytest.raises(
        ValueError,
        match="expected at least one byte per gaussian after the first 262144, got 2000000",
    ):
        v3dg.read_asset(path)


def test_too_much_json_is_named(tmp_path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(ASSET)})
    file.document["extras"] = "x" * (1 << 20)
    with pytest.raises(ValueError, match="expected at most 1048576 bytes of JSON, got 10"):
        v3dg.read_asset(file.write(tmp_path / "a.glb"))
    large = random_gaussians(np.random.default_rng(0), 10_000, 2)
    file = GltfFile()
    file.nodes({"mesh": file.mesh(large)})
    path = file.write(tmp_path / "a.gltf")
    # the bytes of the buffers do not count towards the bound
    assert path.stat().st_size > 1 << 20
    assert_same(read(path), large)


def test_a_document_that_is_no_object_is_refused(tmp_path):
    for value in ([], 3, "x"):
        for path in (tmp_path / "a.glb", tmp_path / "a.gltf"):
            content = glb_bytes(value) if path.suffix == ".glb" else json.dumps(value).encode()
            path.write_bytes(content)
            with pytest.raises(ValueError, match=f"{Path(path).name}: "):
                v3dg.read_asset(path)
