"""Reading and writing OpenUSD. OpenUSD's own validators check the files, and its own
selection of levels is tested."""

import json
import math
import os
import sys
import zipfile

import numpy as np
import pytest

import v3dg
from command_line import run
from half_turns import half_turn
from random_bundle import random_bundle, random_gaussians
from v3dg.export import write_usd
from v3dg.formats._packing import SH_C0
from v3dg.io import open_asset

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLod, UsdValidation, Vt


def assert_same(found, wanted, rtol=0.0):
    for name, values in vars(found).items():
        np.testing.assert_allclose(
            values, getattr(wanted, name), rtol=rtol, atol=1e-6, err_msg=name
        )


def assert_valid(path):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(os.fspath(path)))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in errors] == []


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc", "usdz"])
def test_an_asset_reads_back(tmp_path, suffix, degree):
    asset = random_gaussians(np.random.default_rng(degree), 50, degree)
    v3dg.write_asset(tmp_path / f"a.{suffix}", asset)
    assert_same(v3dg.read_asset(tmp_path / f"a.{suffix}"), asset)
    assert_valid(tmp_path / f"a.{suffix}")
    assert (tmp_path / "a.usda").exists() == (suffix == "usda")
    assert os.listdir(tmp_path) == [f"a.{suffix}"]
    if suffix == "usda":
        assert (tmp_path / "a.usda").read_text().startswith("#usda 1.0")


@pytest.mark.parametrize("degree", range(4))
def test_coefficients_say_how_many_belong_to_a_gaussian(tmp_path, degree):
    """Requirement VG.035 of NVIDIA's usd-validation: the interpolation is `vertex`, and
    the elementSize is the number of coefficients of the degree."""
    path = tmp_path / "a.usdc"
    v3dg.write_asset(path, random_gaussians(np.random.default_rng(0), 5, degree))
    stage = Usd.Stage.Open(os.fspath(path))
    prim = stage.GetDefaultPrim()
    harmonics = UsdGeom.Primvar(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients"))
    assert harmonics.GetInterpolation() == "vertex"
    assert harmonics.GetElementSize() == (degree + 1) ** 2


@pytest.mark.witness
@pytest.mark.parametrize("name", ["asset.usdc", "asset.usdz", "scene.usda"])
def test_nvidias_rules_find_nothing(tmp_path, name):
    """The rules are those that usd-validation-nvidia enables, except for its advice to
    store large arrays in binary files, and additionally the rule for splats."""
    nvidia = pytest.importorskip("usd_validation_nvidia")
    generator = np.random.default_rng(0)
    if name == "scene.usda":
        scene = v3dg.Scene()
        scene.add(random_bundle(generator), positions=[[0, 0, 0], [3, 0, 0]])
        write_usd(scene, tmp_path / name)
    else:
        v3dg.write_asset(tmp_path / name, random_gaussians(generator, 50, 3))
    engine = nvidia.ValidationEngine()
    engine.enable_rule(nvidia.GaussianSplatSchemaChecker)
    found = [str(issue) for issue in engine.validate(os.fspath(tmp_path / name)).issues()]
    assert [text for text in found if "UsdAsciiPerformanceChecker" not in text] == []


def test_no_gaussians_are_written(tmp_path):
    v3dg.write_asset(tmp_path / "a.usdc", random_gaussians(np.random.default_rng(0), 0, 1))
    assert len(v3dg.read_asset(tmp_path / "a.usdc")) == 0


def test_prims_stand_where_their_transforms_put_them(tmp_path):
    asset = random_gaussians(np.random.default_rng(0), 50, 2)
    v3dg.write_asset(tmp_path / "a.usda", asset)
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usda"))
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/gaussians"))
    prim.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    prim.AddOrientOp().Set(Gf.Quatf(0.5, 0.5, -0.5, 0.5))
    scale = prim.AddScaleOp()
    scale.Set(Gf.Vec3f(2, 2, 2))
    stage.GetRootLayer().Save()
    wanted = half_turn(asset, "x").transform((0.5, 0.5, -0.5, 0.5), (1, 2, 3), 2.0)
    found = half_turn(v3dg.read_asset(tmp_path / "a.usda"), "x")
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-5)
    scale.Set(Gf.Vec3f(2, 2, 1))
    stage.GetRootLayer().Save()
    with pytest.raises(ValueError, match="a transform of /gaussians that is more than a rotation"):
        v3dg.read_asset(tmp_path / "a.usda")


@pytest.mark.parametrize("seed", range(4))
def test_a_bundle_has_its_levels(tmp_path, seed):
    bundle = random_bundle(seed, num_levels=1 + seed, sh_degree=seed)
    write_usd(bundle, tmp_path / "a.usdc", up="z")
    assert_valid(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    levels = stage.GetPrimAtPath("/world/bundle").GetChildren()
    for level, prim in enumerate(levels):
        wanted = bundle.level_gaussians(level)
        np.testing.assert_array_equal(np.array(prim.GetAttribute("positions").Get()), wanted.means)
    assert len(levels) == bundle.num_levels
    # rotates z to -y
    turned = bundle.level_gaussians(0).transform((0.5**0.5, 0.5**0.5, 0, 0))
    assert_same(v3dg.read_asset(tmp_path / "a.usdc"), turned)


def test_usd_chooses_the_level_that_selection_has(tmp_path):
    """In a picture of 1920 x 1080, level 1 begins where half of its groups suffice."""
    bundle = random_bundle(3, num_levels=4)
    write_usd(bundle, tmp_path / "a.usdc", up="z")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    root = stage.GetPrimAtPath("/world/bundle")
    (target,) = UsdLod.RootAPI(root).GetLodHeuristicsRel().GetTargets()
    heuristic = UsdLod.ScreenSizeHeuristic(stage.GetPrimAtPath(target))
    low, high = heuristic.GetExtentAttr().Get()
    detail = v3dg.export._common.detail_of(bundle)
    focal = 900.0
    for level in range(1, bundle.num_levels):
        start = focal * detail["reach"] / math.sqrt(3) * detail["ratio"] ** (level - 1)
        for distance, wanted in ((start * 0.98, level - 1), (start * 1.02, level)):
            frustum = Gf.Frustum()
            frustum.SetPerspective(2 * math.degrees(math.atan(540 / focal)), 1920 / 1080, 1e-3, 1e9)
            frustum.SetPosition(Gf.Vec3d((low + high) / 2) + Gf.Vec3d(0, 0, distance))
            query = heuristic.CreateScreenSizeHeuristicQuery()
            assert query.ComputeLOD(frustum, Gf.Matrix4d(1)) == wanted


def test_a_scene_is_a_point_instancer(tmp_path):
    bundles = [random_bundle(seed, num_levels=3) for seed in (1, 2)]
    scene = v3dg.Scene()
    turns = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [1, 0, 0, 1]]
    scene.add([bundles[0], bundles[1], bundles[0]], np.eye(3) * 9, turns, [1, 2, 0.5])
    write_usd(scene, tmp_path / "a.usdc", up="y")
    assert_valid(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath("/world/instances"))
    assert list(instancer.GetProtoIndicesAttr().Get()) == scene.instance_bundle.tolist()
    matrices = np.array(instancer.ComputeInstanceTransformsAtTime(0, 0))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/world")))
    # y of the prototype is z in the world
    np.testing.assert_allclose([0, 1, 0, 0] @ world, [0, 0, 1, 0], atol=1e-6)
    for i, matrix in enumerate(matrices):
        # Vectors in OpenUSD are rows, so instances come before the transforms of the
        # prototypes, which are identities here.
        np.testing.assert_allclose(
            matrix[:3, :3].T, scene.scales[i] * scene.rotations[i], atol=1e-3
        )
        np.testing.assert_allclose(matrix[3, :3], scene.positions[i], atol=1e-5)
    with pytest.raises(ValueError, match="without instances, got instances in /world/instances"):
        v3dg.read_asset(tmp_path / "a.usdc")


def test_the_command_writes_a_file(tmp_path):
    random_bundle(3).write(tmp_path / "3 a.v3dg")
    done = run("export", "3 a.v3dg", "-o", "b.usdc", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("b.usdc: ")
    assert len(v3dg.read_asset(tmp_path / "b.usdc")) == len(random_bundle(3).level_gaussians(0))
    assert run("export", "3 a.v3dg", "-o", "new/b.usdc", cwd=tmp_path).returncode == 0
    assert (tmp_path / "new" / "b.usdc").exists()


def test_bad_files_are_refused(tmp_path):
    (tmp_path / "a.usda").write_text("#usda 1.0\n(\n")
    (tmp_path / "b.usdc").write_bytes(b"PXR-USDC" + bytes(100))
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef Xform "world" {}\n')
    for name in ("a.usda", "b.usdc", "c.usda"):
        with pytest.raises(ValueError, match=f"{name}: expected OpenUSD with gaussians"):
            v3dg.read_asset(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        v3dg.read_asset(tmp_path / "none.usda")
    with pytest.raises(ValueError, match=r"path: expected '\.usd' or"):
        write_usd(random_bundle(3), tmp_path / "a.usdx")
    with pytest.raises(
        ValueError, match="scene: expected at least one instance to export, got none"
    ):
        write_usd(v3dg.Scene(), tmp_path / "none.usda")


def test_a_file_of_another_kind_is_told_by_its_name(tmp_path):
    (tmp_path / "a.ply").touch()
    with pytest.raises(
        ValueError, match=r"a\.ply: expected a file name ending in \.usd, \.usda, \.usdc, \.usdz$"
    ):
        v3dg.read_usd_scene(tmp_path / "a.ply")


def test_a_world_without_cameras_is_drawn_as_a_whole_or_from_a_file(tmp_path):
    random_bundle(3).write(tmp_path / "a.v3dg")
    scene = v3dg.Scene()
    scene.add(v3dg.open(tmp_path / "a.v3dg"), positions=[[0, 0, 0], [1, 0, 0]])
    write_usd(scene, tmp_path / "world.usda")
    camera = v3dg.turntable((0, 0, 0), 8, 1, width=24, height=16)[0]
    v3dg.write_cameras(tmp_path / "cameras.json", {"front": camera})
    whole = run("render", "world.usda", "--size", 40, 30, "--json", cwd=tmp_path)
    assert whole.returncode == 0, whole.stderr
    assert json.loads(whole.stdout)["pictures"][0]["gaussians_in_frustum"] > 0
    done = run("render", "world.usda", "--cameras", "cameras.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "24 x 16" in done.stdout


def test_without_usd_core_the_error_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    v3dg.formats.usd.pxr.cache_clear()
    with pytest.raises(ImportError, match=r"OpenUSD: expected .*pip install 'usd-core>=26.11'"):
        v3dg.write_asset(tmp_path / "a.usdc", random_gaussians(np.random.default_rng(0), 3))
    assert os.listdir(tmp_path) == []


def world_means(scene):
    """Return the means of all gaussians of the finest levels, in the world."""
    found = [scene.bundles[b].level_gaussians(0).means for b in scene.instance_bundle]
    poses = zip(found, scene.rotations, scene.scales, scene.positions, strict=True)
    means = np.concatenate(
        [scale * means @ turn.T + position for means, turn, scale, position in poses]
    )
    return means[np.lexsort(np.round(means.T, 3))]


@pytest.mark.parametrize("suffix", ["usdc", "usdz"])
def test_a_scene_reads_back_as_a_scene(tmp_path, suffix):
    scene = v3dg.Scene()
    bundles = [random_bundle(seed, num_levels=3, sh_degree=1) for seed in (1, 2)]
    turns = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [1, 0, 0, 1]]
    scene.add([bundles[0], bundles[1], bundles[0]], np.eye(3) * 9, turns, [1, 2, 0.5])
    write_usd(scene, tmp_path / f"a.{suffix}", up="z")
    found = v3dg.open(tmp_path / f"a.{suffix}")
    assert isinstance(found, v3dg.Scene)
    assert found.up == "z"
    assert found.instance_bundle.tolist() == [0, 1, 0]
    np.testing.assert_allclose(found.positions, scene.positions, atol=1e-5)
    np.testing.assert_allclose(found.rotations, scene.rotations, atol=1e-5)
    np.testing.assert_allclose(found.scales, scene.scales, rtol=1e-6)
    np.testing.assert_allclose(world_means(found), world_means(scene), atol=1e-4)
    assert found.bundles[0].num_levels >= 1


@pytest.mark.parametrize("is_instanceable", [True, False])
def test_references_to_an_asset_are_instances_of_it(tmp_path, is_instanceable):
    """Nested Xforms refer to files in the same folder. An asset without references is
    one instance, and an asset with other values is a separate asset."""
    asset = Usd.Stage.CreateNew(os.fspath(tmp_path / "asset.usdc"))
    asset.SetDefaultPrim(UsdGeom.Xform.Define(asset, "/house").GetPrim())
    v3dg.formats.usd.define(
        asset, "/house/walls", random_gaussians(np.random.default_rng(0), 50, 1)
    )
    asset.GetRootLayer().Save()
    stage = Usd.Stage.CreateNew(os.fspath(tmp_path / "world.usda"))
    UsdGeom.SetStageUpAxis(stage, "Y")
    street = UsdGeom.Xform.Define(stage, "/world/street")
    street.AddTranslateOp().Set(Gf.Vec3d(0, 100, 0))
    for number in range(3):
        house = UsdGeom.Xform.Define(stage, f"/world/street/house_{number}")
        house.AddTranslateOp().Set(Gf.Vec3d(10 * number, 0, 0))
        house.AddScaleOp().Set(Gf.Vec3f(number + 1))
        house.GetPrim().GetReferences().AddReference("asset.usdc")
        house.GetPrim().SetInstanceable(is_instanceable)
    stage.DefinePrim("/world/faint").GetReferences().AddReference("asset.usdc")
    stage.GetPrimAtPath("/world/faint/walls").GetAttribute("opacities").Set([0.5] * 50)
    stage.GetRootLayer().Save()
    scene = v3dg.read_usd_scene(tmp_path / "world.usda")
    assert scene.up == "y"
    assert scene.instance_bundle.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(
        scene.positions, [[0, 100, 0], [10, 100, 0], [20, 100, 0], [0, 0, 0]], atol=1e-5
    )
    np.testing.assert_allclose(scene.scales, [1, 2, 3, 1], rtol=1e-6)
    assert (scene.bundles[1].level_gaussians(0).opacities == 0.5).all()
    opened = v3dg.open(tmp_path / "world.usda")
    assert isinstance(opened, v3dg.Scene if is_instanceable else v3dg.Gaussians)
    assert is_instanceable or len(opened) == 200


def test_instancers_may_hold_instancers_and_hide_instances(tmp_path):
    stage = Usd.Stage.CreateNew(os.fspath(tmp_path / "world.usda"))
    v3dg.formats.usd.define(
        stage, "/rows/row/tree", random_gaussians(np.random.default_rng(0), 20, 0)
    )
    for path, step in (("/rows", (0, 10, 0)), ("/rows/row", (1, 0, 0))):
        instancer = UsdGeom.PointInstancer.Define(stage, path)
        instancer.CreatePrototypesRel().SetTargets(
            [f"{path}/{'row' if path == '/rows' else 'tree'}"]
        )
        instancer.CreateProtoIndicesAttr([0, 0, 0])
        instancer.CreatePositionsAttr([Gf.Vec3f(*step) * k for k in range(3)])
        # Most programs write orientations in half precision.
        instancer.CreateOrientationsAttr([Gf.Quath(0.5, 0.5, -0.5, 0.5)] * 3)
    UsdGeom.PointInstancer(stage.GetPrimAtPath("/rows")).InvisId(1, 0)
    stage.GetRootLayer().Save()
    scene = v3dg.open(tmp_path / "world.usda")
    assert len(scene.bundles) == 1
    turn = v3dg.rotations.rotation_from_quaternion(np.array([0.5, 0.5, -0.5, 0.5]))
    wanted = [
        np.array([0, 10, 0]) * row + turn @ [tree, 0, 0] for row in (0, 2) for tree in range(3)
    ]
    np.testing.assert_allclose(scene.positions, wanted, atol=1e-5)
    np.testing.assert_allclose(scene.rotations, np.broadcast_to(turn @ turn, (6, 3, 3)), atol=1e-5)


def test_a_world_is_known_to_the_command_line(tmp_path):
    scene = v3dg.Scene()
    scene.add(random_bundle(3), [[0, 0, 0], [4, 0, 0]])
    write_usd(scene, tmp_path / "a.usdc", up="z")
    done = run("info", "a.usdc", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["instances"] == 2
    done = run("export", "a.usdc", "--to", "tiles", "--json", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["instances"] == 2


def new_prim(stage, path="/gaussians", kind="ParticleField3DGaussianSplat"):
    return stage.DefinePrim(path, kind)


def new_stage(path):
    stage = Usd.Stage.CreateNew(os.fspath(path))
    UsdGeom.SetStageUpAxis(stage, "Y")
    return stage


def read_with_notes(path):
    """Return the gaussians in the axes of their stage, and the other declarations of
    the file."""
    file = open_asset(path)
    return half_turn(file.read(0, file.num_gaussians), "x"), list(file.declared.notes)


POINTS = [Gf.Vec3f(1, 2, 3), Gf.Vec3f(4, 5, 6)]


def test_what_is_left_out_has_the_default_of_the_schema(tmp_path):
    """The schema's documentation gives the defaults: no rotation, unit scale, opaque,
    and one grey."""
    stage = new_stage(tmp_path / "a.usda")
    new_prim(stage).GetAttribute("positions").Set(POINTS)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    assert notes == []
    assert len(found) == 2
    np.testing.assert_array_equal(found.quats, [[1, 0, 0, 0]] * 2)
    np.testing.assert_array_equal(found.scales, np.ones((2, 3)))
    np.testing.assert_array_equal(found.opacities, np.ones(2))
    np.testing.assert_array_equal(found.sh, np.zeros((2, 1, 3)))


def test_no_positions_are_no_gaussians(tmp_path):
    stage = new_stage(tmp_path / "a.usda")
    new_prim(stage).GetAttribute("opacities").Set([1.0])
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    assert len(found) == 0
    (note,) = notes
    assert "1 values of opacities for 0 in /gaussians are too many" in note


def test_the_degree_of_harmonics_is_3_by_default(tmp_path):
    stage = new_stage(tmp_path / "a.usda")
    prim = new_prim(stage)
    prim.GetAttribute("positions").Set(POINTS)
    values = np.arange(96, dtype=np.float32).reshape(32, 3)
    name = "radiance:sphericalHarmonicsCoefficients"
    prim.GetAttribute(name).Set(Vt.Vec3fArray.FromNumpy(values))
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.sh, values.reshape(2, 16, 3))
    assert notes == []
    # The coefficients are too few for degree 4, so they are ignored. For degree 2, the
    # last ones are ignored.
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(4)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.sh, np.zeros((2, 1, 3)))
    lengths = f"32 values of {name} for 50 in /gaussians"
    assert notes[0] == f"{lengths} are too few, so the default of the schema was used."
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(2)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.sh, values[:18].reshape(2, 9, 3))
    assert notes == [
        f"32 values of {name} for 18 in /gaussians are too many, so the last values were ignored."
    ]
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(-1)
    stage.GetRootLayer().Save()
    with pytest.raises(ValueError, match="got an invalid SH degree, -1, in /gaussians"):
        v3dg.read_asset(tmp_path / "a.usda")


def test_coefficients_above_degree_3_are_left_out(tmp_path):
    stage = new_stage(tmp_path / "a.usda")
    prim = new_prim(stage)
    prim.GetAttribute("positions").Set(POINTS)
    values = np.arange(150, dtype=np.float32).reshape(50, 3)
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(4)
    name = "radiance:sphericalHarmonicsCoefficients"
    prim.GetAttribute(name).Set(Vt.Vec3fArray.FromNumpy(values))
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.sh, values.reshape(2, 25, 3)[:, :16])
    assert notes == ["Coefficients above SH degree 3 were ignored."]


def test_halves_stand_for_floats(tmp_path):
    """If a file has both, the floats are used."""
    stage = new_stage(tmp_path / "a.usda")
    prim = new_prim(stage)
    prim.GetAttribute("positionsh").Set([Gf.Vec3h(1, 2, 3), Gf.Vec3h(4, 5, 6)])
    prim.GetAttribute("orientationsh").Set([Gf.Quath(0, 1, 0, 0)] * 2)
    prim.GetAttribute("scalesh").Set([Gf.Vec3h(0.5, 1, 2)] * 2)
    prim.GetAttribute("opacitiesh").Set([0.25, 0.5])
    prim.GetAttribute("opacities").Set([0.75, 1.0])
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(0)
    name = "radiance:sphericalHarmonicsCoefficientsh"
    prim.GetAttribute(name).Set([Gf.Vec3h(1, 0, -1)] * 2)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.means, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.quats, [[0, 1, 0, 0]] * 2)
    np.testing.assert_array_equal(found.scales, [[0.5, 1, 2]] * 2)
    np.testing.assert_array_equal(found.opacities, [0.75, 1])
    np.testing.assert_array_equal(found.sh, [[[1, 0, -1]]] * 2)
    assert notes == []


def test_prims_of_several_degrees_are_one_asset(tmp_path):
    assets = [random_gaussians(np.random.default_rng(seed), 9, seed) for seed in (0, 2)]
    stage = new_stage(tmp_path / "a.usda")
    UsdGeom.Xform.Define(stage, "/up").AddTranslateOp().Set(Gf.Vec3d(0, 5, 0))
    v3dg.formats.usd.define(stage, "/up/small", assets[0])
    v3dg.formats.usd.define(stage, "/large", assets[1])
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_allclose(found.means[:9], assets[0].means + np.array([0, 5, 0]), rtol=1e-6)
    np.testing.assert_array_equal(found.sh[:9, :1], assets[0].sh)
    assert not found.sh[:9, 1:].any()
    np.testing.assert_array_equal(found.sh[9:], assets[1].sh)
    assert notes == []


@pytest.mark.parametrize("change", ["invisible", "proxy", "guide"])
def test_what_is_not_drawn_is_left_out_and_told(tmp_path, change):
    asset = random_gaussians(np.random.default_rng(0), 9, 1)
    stage = new_stage(tmp_path / "a.usda")
    for name in ("shown", "group/hidden"):
        v3dg.formats.usd.define(stage, f"/world/{name}", asset)
    place = UsdGeom.Imageable(stage.OverridePrim("/world/group"))
    if change == "invisible":
        place = UsdGeom.Xform.Define(stage, "/world/group")
        place.MakeInvisible()
    else:
        place = UsdGeom.Imageable(stage.GetPrimAtPath("/world/group/hidden"))
        place.GetPurposeAttr().Set(change)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.means, asset.means)
    (note,) = notes
    assert note.startswith(
        "Prims that are invisible or not meant to be drawn were ignored: '/world/gr"
    )
    stage.RemovePrim("/world/shown")
    stage.GetRootLayer().Save()
    with pytest.raises(ValueError, match=r"no ParticleField3DGaussianSplat. Prims that are invis"):
        v3dg.read_asset(tmp_path / "a.usda")


def test_values_that_change_with_time_are_those_of_the_first_time(tmp_path):
    asset = random_gaussians(np.random.default_rng(0), 2, 0)
    stage = new_stage(tmp_path / "a.usda")
    prim = v3dg.formats.usd.define(stage, "/a", asset)
    prim.GetAttribute("positions").Set([Gf.Vec3f(0)] * 2, 9.0)
    prim.GetAttribute("positions").Set(POINTS, 3.0)
    step = UsdGeom.Xformable(prim).AddTranslateOp()
    step.Set(Gf.Vec3d(1, 0, 0), 1.0)
    step.Set(Gf.Vec3d(2, 0, 0), 2.0)
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_allclose(found.means, [[2, 2, 3], [5, 5, 6]])
    assert notes == ["Values change with time; the first ones were read."]


def test_what_a_prim_says_besides_is_told(tmp_path):
    asset = random_gaussians(np.random.default_rng(0), 2, 0)
    stage = new_stage(tmp_path / "a.usda")
    prim = v3dg.formats.usd.define(stage, "/a", asset)
    prim.GetAttribute("sortingModeHint").Set("rayHitDistance")
    prim.GetAttribute("projectionModeHint").Set("perspective")
    prim.CreateAttribute("velocities", Sdf.ValueTypeNames.Float3Array).Set([Gf.Vec3f(1)] * 2)
    UsdGeom.Sphere.Define(stage, "/ball")
    points = new_prim(stage, "/points", "ParticleField")
    points.ApplyAPI("ParticleFieldKernelConstantSurfletAPI")
    stage.GetRootLayer().Save()
    _, notes = read_with_notes(tmp_path / "a.usda")
    assert notes == [
        "Particles that are not gaussians were ignored: '/points'.",
        "Other geometry was ignored: '/ball'.",
        "The hint sortingModeHint is 'rayHitDistance' and was ignored.",
        "Attributes of gaussians were ignored: 'velocities'.",
    ]


def stage_with_color_space(path, asset, name, place):
    """Return a stage whose coefficients are in the colour space `name`. The function
    `place` declares it."""
    stage = new_stage(path)
    world = UsdGeom.Xform.Define(stage, "/world").GetPrim()
    prim = v3dg.formats.usd.define(stage, "/world/a", half_turn(asset, "x"))
    prim.RemoveProperty("colorSpace:name")
    if place == "attribute":
        prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").SetColorSpace(name)
    else:
        declaring = {"prim": prim, "parent": world}[place]
        Usd.ColorSpaceAPI.Apply(declaring).CreateColorSpaceNameAttr(name)
    stage.GetRootLayer().Save()


@pytest.mark.parametrize("place", ["attribute", "prim", "parent"])
@pytest.mark.parametrize("name", ["lin_rec709_scene", "srgb_rec709_scene", "lin_ap1_scene"])
def test_the_colour_space_of_coefficients_counts(tmp_path, name, place):
    """The declaration of any prim has effect.

    Linear grey of 0.2 is 0.4845 in sRGB (IEC 61966-2-1).
    """
    asset = random_gaussians(np.random.default_rng(0), 3, 1)
    asset.sh[:] = 0
    asset.sh[:, 0] = (0.2 - 0.5) / SH_C0
    stage_with_color_space(tmp_path / "a.usda", asset, name, place)
    found, notes = read_with_notes(tmp_path / "a.usda")
    expected = 0.2
    words = []
    if name == "lin_rec709_scene":
        expected = 0.4845
        words = ["linear (lin_rec709_scene)"]
    elif name == "lin_ap1_scene":
        words = ["'lin_ap1_scene' was read as sRGB"]
    np.testing.assert_allclose(found.sh[:, 0] * SH_C0 + 0.5, expected, atol=1e-4)
    np.testing.assert_allclose(found.sh[:, 1:], 0, atol=1e-4)
    assert len(notes) == len(words)
    assert all(word in note for word, note in zip(words, notes, strict=True))


def test_written_coefficients_declare_their_colour_space(tmp_path):
    v3dg.write_asset(tmp_path / "a.usda", random_gaussians(np.random.default_rng(0), 3, 1))
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/gaussians")
    assert Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_scene"


@pytest.mark.parametrize(
    ("kernel", "depth"), [("GaussianEllipsoid", 1.0), ("GaussianSurflet", 0.0)]
)
def test_particles_of_other_prims_are_read_by_their_kernel(tmp_path, kernel, depth):
    stage = new_stage(tmp_path / "a.usda")
    prim = new_prim(stage, kind="ParticleField")
    for api in ("PositionAttribute", "OpacityAttribute", f"Kernel{kernel}"):
        prim.ApplyAPI(f"ParticleField{api}API")
    prim.GetAttribute("positions").Set(POINTS)
    prim.GetAttribute("opacities").Set([0.25, 0.5])
    stage.GetRootLayer().Save()
    found, notes = read_with_notes(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.means, POINTS)
    np.testing.assert_array_equal(found.scales, [[1, 1, depth]] * 2)
    np.testing.assert_array_equal(found.opacities, [0.25, 0.5])
    assert len(notes) == (depth == 0)


@pytest.mark.parametrize("damage", ["packed", "encrypted", "no layer", "no zip", "shortened"])
def test_packages_must_be_stored(tmp_path, damage):
    v3dg.write_asset(tmp_path / "a.usdz", random_gaussians(np.random.default_rng(0), 9, 1))
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        members = {name: package.read(name) for name in package.namelist()}
    content = (tmp_path / "a.usdz").read_bytes()
    if damage == "packed":
        with zipfile.ZipFile(tmp_path / "b.usdz", "w", zipfile.ZIP_DEFLATED) as package:
            for name, member in members.items():
                package.writestr(name, member)
    elif damage == "encrypted":
        place = content.rindex(b"PK\1\2") + 8
        (tmp_path / "b.usdz").write_bytes(content[:place] + b"\1" + content[place + 1 :])
    elif damage == "no layer":
        with zipfile.ZipFile(tmp_path / "b.usdz", "w") as package:
            package.writestr("a.txt", b"x")
    elif damage == "no zip":
        (tmp_path / "b.usdz").write_bytes(b"#usda 1.0\n")
    else:
        (tmp_path / "b.usdz").write_bytes(content[:-30])
    with pytest.raises(ValueError, match=r"b\.usdz: expected "):
        v3dg.read_asset(tmp_path / "b.usdz")
