"""Whether an asset was trained with antialiasing is read, kept, and used for drawing
and building."""

import copy
import json
import pickle
import warnings
import zipfile
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from command_line import run
from random_bundle import random_gaussians
from test_ply import Element, ply_bytes, random_columns
from v3dg import BuildConfig, Gaussians, build_bundle
from v3dg.cleaning import AssetWarning
from v3dg.formats import sog
from v3dg.formats._declared import Declared
from v3dg.gaussians import TRAINED_FILTER_PX2
from v3dg.io import open_asset
from v3dg.levels import build_file
from v3dg.levels.leaves_on_disk import leaves_on_disk

ASSET = random_gaussians(np.random.default_rng(0), 300, 1)
FAST = BuildConfig(cluster_size=32, steps=0, smooth="no")
NAMES = ["a.ply", "a.compressed.ply", "a.sog", "a.glb", "a.spz"]


def declared(path):
    return open_asset(path).declared.antialiased


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_usd_keeps_it(tmp_path, antialiased):
    pytest.importorskip("pxr")
    path = tmp_path / "a.usda"
    v3dg.write_asset(path, ASSET.trained(antialiased=antialiased))
    assert declared(path) is antialiased
    assert v3dg.read_asset(path).antialiased is antialiased


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("antialiased", [True, False])
def test_files_keep_it(tmp_path, name, antialiased):
    path = tmp_path / name
    v3dg.write_asset(path, ASSET.trained(antialiased=antialiased))
    assert declared(path) is antialiased
    found = v3dg.read_asset(path)
    assert found.antialiased is antialiased
    v3dg.write_asset(tmp_path / "again.spz", found)
    assert declared(tmp_path / "again.spz") is antialiased
    v3dg.write_asset(path, found, antialiased=not antialiased)
    assert declared(path) is not antialiased


@pytest.mark.parametrize("name", NAMES)
def test_files_say_nothing_where_nothing_is_known(tmp_path, name):
    """The header of a `.spz` file always has a bit for antialiasing. It is 0 here."""
    v3dg.write_asset(tmp_path / name, ASSET)
    assert declared(tmp_path / name) is (False if name == "a.spz" else None)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_version_of_spz_keeps_it(tmp_path, version):
    path = tmp_path / "a.spz"
    v3dg.write_asset(path, ASSET, antialiased=True, version=version)
    assert declared(path) is True


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding_of_ply_keeps_it(tmp_path, encoding):
    path = tmp_path / "a.ply"
    v3dg.write_asset(path, ASSET, antialiased=True, encoding=encoding)
    assert b"\ncomment SplatRenderMode: mip\n" in path.read_bytes()[:200]
    assert v3dg.read_asset(path).antialiased is True


COMMENTS = {
    "Brush": (["Exported from Brush", "SH degree: 0", "SplatRenderMode: mip"], True),
    "Brush, default": (["SplatRenderMode: default"], False),
    "2DGS": (["SplatRenderMode: 2dgs"], None),
    "Postshot": (["postshot.anti_aliasing=1"], True),
    "Postshot, off": (["postshot.anti_aliasing=0"], False),
    "after Postshot": (["antialiased 1"], True),
    "any case and space": (["  SPLATRENDERMODE:  MIP  "], True),
    "the last counts": (["antialiased 1", "SplatRenderMode: default"], False),
    "other words": (["antialiased 2", "not antialiased 1", "mip", "SplatRenderMode"], None),
    "none": ([], None),
}


@pytest.mark.parametrize("case", COMMENTS)
@pytest.mark.parametrize("place", ["before", "after"])
def test_comments_of_trainers_are_understood(tmp_path, case, place):
    """The comments may be anywhere in the header."""
    comments, wanted = COMMENTS[case]
    content = ply_bytes([Element("vertex", random_columns(2, 0))], "ascii")
    lines = "".join(f"comment {comment}\n" for comment in comments).encode()
    line = b"element vertex 2\n"
    new = lines + line if place == "before" else line + lines
    (tmp_path / "a.ply").write_bytes(content.replace(line, new))
    assert declared(tmp_path / "a.ply") is wanted
    assert open_asset(tmp_path / "a.ply").declared.notes == ()


def test_a_mode_that_is_not_known_is_told(tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", ASSET, antialiased=True)
    content = (tmp_path / "a.ply").read_bytes().replace(b"Mode: mip", b"Mode: x\xffy")
    (tmp_path / "a.ply").write_bytes(content)
    found = open_asset(tmp_path / "a.ply").declared
    assert found.antialiased is None
    assert found.notes == ("Its SplatRenderMode x?y is unknown, and is not used.",)


def with_meta(path, **fields):
    """Return a `.sog` file with these fields in its meta.json."""
    contents = sog.encode(ASSET)
    meta = json.loads(contents["meta.json"])
    contents["meta.json"] = json.dumps({**meta, **fields}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


SOG = {
    "the specification": ({"antialias": True}, True, ()),
    "splat-transform": ({"model": "antialiased"}, True, ()),
    "splat-transform, 2DGS": (
        {"antialias": True, "model": "2dgs"},
        None,
        ("The gaussians are those of 2DGS; they were read as flat ellipsoids.",),
    ),
    "both": ({"antialias": False, "model": "antialiased"}, True, ()),
    "another model": (
        {"antialias": True, "model": "x"},
        True,
        ('The model "x" is unknown and was ignored.',),
    ),
    "other fields": ({"author": 3}, None, ("Fields of meta.json were ignored: 'author'.",)),
}


@pytest.mark.parametrize("case", SOG)
def test_fields_of_sog_are_understood(tmp_path, case):
    fields, antialiased, notes = SOG[case]
    found = open_asset(with_meta(tmp_path / "a.sog", **fields)).declared
    assert (found.antialiased, found.notes) == (antialiased, notes)


@pytest.mark.parametrize("others", [True, False])
def test_folders_of_streamed_sog_must_agree(tmp_path, others):
    lods = []
    for number, antialiased in enumerate((True, others)):
        (tmp_path / str(number)).mkdir()
        for name, content in sog.encode(ASSET.trained(antialiased=antialiased)).items():
            (tmp_path / str(number) / name).write_bytes(content)
        lods.append({"lods": {"0": {"file": number, "offset": 0, "count": len(ASSET)}}})
    path = tmp_path / "lod-meta.json"
    names = ["0/meta.json", "1/meta.json"]
    path.write_text(json.dumps({"filenames": names, "tree": {"children": lods}}))
    assert declared(path) is (True if others else None)
    with nullcontext() if others else pytest.warns(AssetWarning, match="Some folders were"):
        assert v3dg.read_asset(path).antialiased is declared(path)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"antialias": 1}, "antialias: expected true or false, got 1"),
        ({"model": 3}, "model: expected a string, got 3"),
    ],
)
def test_fields_of_another_kind_are_refused(tmp_path, fields, message):
    with pytest.raises(ValueError, match=message):
        v3dg.read_asset(with_meta(tmp_path / "a.sog", **fields))


def test_flags_of_spz_that_are_not_known_are_told(tmp_path):
    v3dg.write_asset(tmp_path / "a.spz", ASSET, version=4)
    content = bytearray((tmp_path / "a.spz").read_bytes())
    content[14] |= 0x41
    (tmp_path / "a.spz").write_bytes(content)
    found = open_asset(tmp_path / "a.spz").declared
    assert found.antialiased is True
    assert "Its flags 0x40 are unknown and were ignored." in found.notes


def test_what_is_made_of_gaussians_keeps_it():
    asset = ASSET.trained(antialiased=True)
    made = [
        asset.subset(slice(3)),
        asset.subset([1, 2]),
        asset.transform((0, 1, 0, 0)),
        asset.torch(),
        asset.torch().transform(scale=2),
        asset.torch().numpy(),
        Gaussians.concatenate([asset, asset]),
        pickle.loads(pickle.dumps(asset)),
        copy.copy(asset),
    ]
    assert [gaussians.antialiased for gaussians in made] == [True] * len(made)
    assert Gaussians.concatenate([asset, ASSET]).antialiased is None
    assert ASSET.antialiased is None
    assert asset.means is ASSET.means
    assert list(vars(asset)) == ["means", "quats", "scales", "opacities", "sh"]
    with pytest.raises(TypeError, match="antialiased: expected a bool or None, got str"):
        ASSET.trained(antialiased="yes")


CAMERA = v3dg.Camera.look_at((0, -20, 0), (0, 0, 0), width=48, height=48, fov_x=0.3)


def test_an_asset_is_drawn_as_it_was_trained(tmp_path):
    """Seen from far away, a filter without compensation would make the asset thicker,
    and without a filter it would flicker."""
    asset = ASSET.trained(antialiased=True)
    v3dg.write_asset(tmp_path / "a.ply", asset)
    asset = v3dg.read_asset(tmp_path / "a.ply")
    as_trained = v3dg.rasterize(asset, CAMERA, filter_px2=TRAINED_FILTER_PX2, antialiased=True)
    plain = v3dg.rasterize(ASSET, CAMERA)
    assert np.abs(as_trained.color - plain.color).max() > 0.05
    for subject in (asset, tmp_path / "a.ply"):
        picture = v3dg.render(subject, CAMERA, device="cpu")
        np.testing.assert_allclose(picture.color, as_trained.color, atol=1e-6)
    np.testing.assert_array_equal(v3dg.render(ASSET, CAMERA, device="cpu").color, plain.color)
    drawn = v3dg.rasterize(tmp_path / "a.ply", CAMERA, filter_px2=TRAINED_FILTER_PX2)
    np.testing.assert_array_equal(drawn.color, as_trained.color)
    explicit = v3dg.rasterize(asset, CAMERA, filter_px2=TRAINED_FILTER_PX2, antialiased=False)
    assert np.abs(explicit.color - as_trained.color).max() > 0.05


def look_of(bundle):
    """Return the filter and the compensation of the clusters of level 0."""
    level = bundle.clusters.level == 0
    filters = set(bundle.clusters.filter_px2[level].tolist())
    return filters, set(bundle.clusters.antialiased[level].tolist())


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_a_bundle_has_it_from_the_asset(tmp_path, antialiased):
    asset = ASSET.trained(antialiased=antialiased)
    bundle = build_bundle(asset, config=FAST, progress=False, device="cpu")
    wanted = ({np.float32(TRAINED_FILTER_PX2).item()}, {1}) if antialiased else ({0.0}, {0})
    assert look_of(bundle) == wanted
    assert bundle.config["build"]["asset_antialiased"] is bool(antialiased)
    assert bundle.level_gaussians(0).antialiased is (True if antialiased else None)
    v3dg.write_asset(tmp_path / "a.spz", asset)
    built, _ = build_file(
        tmp_path / "a.spz", tmp_path / "a.v3dg", config=FAST, progress=False, device="cpu"
    )
    assert look_of(built) == wanted


@pytest.mark.parametrize("antialiased", [True, False])
def test_settings_win_over_the_asset_and_the_contradiction_is_told(antialiased):
    asset = ASSET.trained(antialiased=not antialiased)
    config = replace(FAST, asset_antialiased=antialiased, asset_filter_px2=0.1)
    with pytest.warns(AssetWarning, match="asset: declared as trained with"):
        bundle = build_bundle(asset, config=config, progress=False, device="cpu")
    assert look_of(bundle) == ({np.float32(0.1).item()}, {int(antialiased)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build_bundle(ASSET, config=config, progress=False, device="cpu")


def test_files_of_one_asset_that_differ_are_not_antialiased(tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", ASSET, antialiased=True)
    v3dg.write_asset(tmp_path / "b.ply", ASSET, antialiased=False)
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    bundle, _ = build_file(paths, tmp_path / "a.v3dg", config=FAST, progress=False, device="cpu")
    assert look_of(bundle) == ({0.0}, {0})


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_comments_declare_antialiasing_and_what_is_up_together(tmp_path, name):
    path = tmp_path / name
    v3dg.write_asset(path, ASSET, antialiased=True)
    content = path.read_bytes()
    lines = b"comment Vertical Axis: Z\ncomment SplatRenderMode: blur\nend_header\n"
    path.write_bytes(content.replace(b"end_header\n", lines))
    note = "Its SplatRenderMode blur is unknown, and is not used."
    assert open_asset(path).declared == Declared("z", "as its header says", True, (note,))


def test_files_that_have_axes_declare_all_together(tmp_path):
    v3dg.write_asset(tmp_path / "a.spz", ASSET, antialiased=True)
    reason = "as its record of axes says (RUB)"
    assert open_asset(tmp_path / "a.spz").declared == Declared("-y", reason, True)
    v3dg.write_asset(tmp_path / "a.glb", ASSET, antialiased=True)
    assert open_asset(tmp_path / "a.glb").declared == Declared("-y", "as in glTF", True)


def test_leaves_on_disk_keep_it(tmp_path):
    """An asset that is sorted on disk has no object in memory that could record the
    antialiasing."""
    v3dg.write_asset(tmp_path / "a.ply", ASSET, antialiased=True)
    for most_in_memory in (len(ASSET), 10):
        with leaves_on_disk(
            [tmp_path / "a.ply"],
            tmp_path / "scratch",
            memory=1 << 30,
            config=FAST,
            most_in_memory=most_in_memory,
        ) as leaves:
            assert leaves.antialiased is True


def test_commands_say_it_once(tmp_path):
    v3dg.write_asset(tmp_path / "a.spz", ASSET, antialiased=True)
    options = ("--quiet", "--cluster-size", 64)
    done = [
        run("info", tmp_path / "a.spz"),
        run("convert", tmp_path / "a.spz", tmp_path / "b.ply"),
        run("build", tmp_path / "a.spz", *options),
        run("convert", tmp_path / "a.v3dg", tmp_path / "c.ply"),
        run(
            "build", tmp_path / "a.spz", "-o", tmp_path / "b.v3dg", "--antialiased", "no", *options
        ),
    ]
    texts = [process.stdout + process.stderr for process in done]
    assert [text.count("trained with antialiasing") for text in texts] == [1] * len(texts)
    assert "asset_antialiased=False" in texts[-1]


def test_convert_says_once_what_is_not_read(tmp_path):
    content = sog.encode(ASSET)
    content["meta.json"] = json.dumps({**json.loads(content["meta.json"]), "fog": 1}).encode()
    for name, part in content.items():
        (tmp_path / name).write_bytes(part)
    done = run("convert", tmp_path / "meta.json", tmp_path / "a.ply")
    assert done.stderr.count("Fields of meta.json were ignored: 'fog'.") == 1


def test_commands_keep_it(tmp_path):
    v3dg.write_asset(tmp_path / "a.spz", ASSET, antialiased=True)
    run("convert", tmp_path / "a.spz", tmp_path / "b.ply")
    assert declared(tmp_path / "b.ply") is True
    run("convert", tmp_path / "b.ply", tmp_path / "c.sog")
    assert declared(tmp_path / "c.sog") is True
