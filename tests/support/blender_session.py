"""Tests the add-on inside Blender, with a function for each behaviour. test_blender.py
runs this file in an empty folder with a Python that has bpy.

Prints the name and the error of each function as JSON. "" means success.
"""

import importlib
import json
import os
import sys
import traceback
import types
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "integrations" / "blender")]

import bpy  # noqa: E402
import mathutils  # noqa: E402
import numpy as np  # noqa: E402
from bpy_extras.object_utils import world_to_camera_view  # noqa: E402

import v3dg  # noqa: E402
import v3dg_blender  # noqa: E402
from v3dg_blender import operators, show, splats, views, watch, world  # noqa: E402

CHECKS = []


def check(function):
    CHECKS.append(function)
    return function


def make_bundle(name, *, seed=0, count=2000, sh_degree=1, opacity=0.9):
    """Write a bundle of a unit ball of gaussians."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.4, (count, (sh_degree + 1) ** 2, 3)).astype(np.float32)
    sh[:, 1:] *= 0.5  # keeps most colours within the range
    asset = v3dg.Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32) * 0.3,
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=np.exp(rng.normal(-3.5, 0.3, (count, 3))).astype(np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh=sh,
    )
    config = v3dg.BuildConfig(steps=0, cluster_size=64)
    v3dg.build_bundle(asset, config=config, progress=False, device="cpu").write(name)
    return os.path.abspath(name)


def add_camera(location, target=(0, 0, 0), **lens):
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.collection.objects.link(camera)
    camera.location = location
    towards = mathutils.Vector(target) - mathutils.Vector(location)
    camera.rotation_euler = towards.to_track_quat("-Z", "Y").to_euler()
    for name, value in lens.items():
        setattr(camera.data, name, value)
    bpy.context.scene.camera = camera
    bpy.context.scene.render.resolution_x = 160
    bpy.context.scene.render.resolution_y = 120
    bpy.context.view_layer.update()
    return camera


def depsgraph():
    bpy.context.view_layer.update()
    return bpy.context.evaluated_depsgraph_get()


def values(block, name):
    """Return the values of an attribute, (N, width)."""
    attribute = block.attributes[name]
    kind = splats._VALUES[attribute.data_type]
    width = {"FLOAT_VECTOR": 3, "QUATERNION": 4, "FLOAT4": 4, "FLOAT_COLOR": 4}[attribute.data_type]
    result = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(kind, result)
    return result.reshape(-1, width)


def size(item):
    if splats.has_splats():
        return len(item.data.points)
    return len(item.data.vertices)


def in_world(item):
    """Return the means that an object shows, in world space, in ascending order."""
    matrix = np.array(item.matrix_world)
    means = values(item.data, "position").astype(np.float64)
    return np.sort(means @ matrix[:3, :3].T + matrix[:3, 3], axis=0)


def failure(operator, **arguments):
    """Return the report with which an operator fails."""
    try:
        operator(**arguments)
    except RuntimeError as error:
        return str(error)
    raise AssertionError("the operator did not fail")


@check
def a_bundle_stands_upright_at_the_cursor_with_its_coarsest_cut():
    path = make_bundle("ball.v3dg")
    bpy.context.scene.cursor.location = (1, 2, 3)
    bpy.ops.v3dg.open(filepath=path)
    item = bpy.context.object
    assert item.v3dg.bundle == path
    assert item.rotation_quaternion == mathutils.Quaternion()
    scene = v3dg.Scene()
    scene.add(v3dg.Bundle.open(path), (1, 2, 3), up="z")
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=8)
    cut = v3dg.select(scene, camera, tolerance=np.inf, cull=False).gaussians()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(in_world(item), np.sort(cut.means, axis=0), atol=1e-5)


@check
def the_cut_of_the_camera_is_that_of_v3dg_and_meets_the_budget():
    path = make_bundle("ball.v3dg")
    bpy.ops.v3dg.open(filepath=path)
    item = bpy.context.object
    item.rotation_euler = (0.3, -0.2, 1)
    item.scale = (2, 2, 2)
    camera = add_camera((1, -3, 1), (0.5, 0, 0), lens=80)
    settings = bpy.context.scene.v3dg
    for budget in (400, 900):
        settings.render_budget = budget
        shown = show.show_render(bpy.context.scene, depsgraph())
        scene = v3dg.Scene()
        world.add_instances(scene, [item], np.array(item.matrix_world)[None])
        lens = views.render_camera(bpy.context.scene, camera, depsgraph())
        cut = v3dg.select(scene, lens, tolerance=3, budget=budget)
        assert 0 < size(item) == shown.num_gaussians == cut.num_gaussians <= budget
        expected = np.sort(cut.gaussians().means, axis=0)
        np.testing.assert_allclose(in_world(item), expected, atol=2e-5)


@check
def attributes_are_those_that_blender_draws():
    path = make_bundle("ball.v3dg")
    bpy.ops.v3dg.open(filepath=path)
    block = bpy.context.object.data
    scene = v3dg.Scene()
    scene.add(v3dg.Bundle.open(path), up="z")
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=8)
    cut = v3dg.select(scene, camera, tolerance=np.inf, cull=False).gaussians()
    np.testing.assert_array_equal(values(block, "scale"), cut.scales)
    if not splats.has_splats():
        np.testing.assert_allclose(values(block, "radiance")[:, 3], cut.opacities)
        return
    # The result is compared with Blender's own import of a .ply file with the same
    # gaussians.
    v3dg.write_asset("cut.ply", cut)
    bpy.ops.wm.ply_import(filepath=os.path.abspath("cut.ply"))
    witness = bpy.context.object.data
    assert block.type == witness.type
    assert sorted(witness.attributes.keys()) == sorted(block.attributes.keys())
    for name in sorted(witness.attributes.keys()):
        assert block.attributes[name].data_type == witness.attributes[name].data_type
        expected = values(witness, name)
        if name == "rotation":
            expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(
            values(block, name), expected, rtol=2e-5, atol=2e-6, err_msg=name
        )


@check
def instances_with_equal_cuts_share_a_data_block():
    path = make_bundle("ball.v3dg")
    add_camera((0, -4, 1))
    bpy.context.scene.v3dg.tolerance_px2 = 0
    for number in range(150):
        matrix = mathutils.Matrix.Translation((number % 10 - 4.5, 3 * (number // 10), 0))
        world.new_instance(path, matrix, bpy.context.collection)
    items = world.instances(bpy.context.scene)
    bpy.context.scene.v3dg.render_budget = 20_000
    shown = show.show_render(bpy.context.scene, depsgraph())
    assert sum(size(item) for item in items) == shown.num_gaussians <= 20_000
    blocks = {item.data.name for item in items}
    assert len(splats.data_blocks()) == len(blocks)
    assert shown.num_blocks < shown.num_instances / 2
    # Instances of two appearances have two different data blocks.
    far = items[-1]
    near_twin = next(item for item in items[:-1] if item.data == far.data)
    far.v3dg.tint = (0.5, 1, 1)
    far.v3dg.opacity = 0.5
    show.show_render(bpy.context.scene, depsgraph())
    assert far.data != near_twin.data
    name = "radiance:base" if splats.has_splats() else "radiance"
    ratio = values(far.data, name)[:, 3] / values(near_twin.data, name)[:, 3]
    np.testing.assert_allclose(ratio, 0.5, rtol=1e-6)
    # Data blocks of earlier cuts are removed.
    for item in items:
        item.v3dg.importance = 1e-3
    bpy.context.scene.v3dg.render_budget = 8_000
    show.show_render(bpy.context.scene, depsgraph())
    assert len(splats.data_blocks()) == len({item.data.name for item in items})


def viewport_at(camera):
    """Return a viewport with the view of a camera, in place of one in a window."""
    view = views.render_camera(bpy.context.scene, camera, depsgraph())
    window = camera.calc_matrix_camera(depsgraph(), x=view.width, y=view.height)
    looking = camera.matrix_world.normalized().inverted()
    region = types.SimpleNamespace(
        width=view.width, height=view.height, as_pointer=lambda: 1, tag_redraw=lambda: None
    )
    region_view = types.SimpleNamespace(
        view_matrix=looking, window_matrix=window, perspective_matrix=window @ looking
    )
    return watch.Viewport(region, region_view, camera.data.clip_start)


@check
def the_timer_follows_the_view_and_the_instances():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    item = bpy.context.object
    camera = add_camera((0, -3, 0))
    found = watch.viewports
    sizes = []

    def look():
        watch._state.pace._not_before_s = 0.0  # without waiting
        watch.viewports = lambda: [viewport_at(camera)]
        watch._look()
        bpy.context.view_layer.update()
        sizes.append((size(item), item.data.name))

    try:
        look()
        assert sizes[0][0] == show.show_render(bpy.context.scene, depsgraph()).num_gaussians
        look()  # the second call finds no change
        assert sizes[1] == sizes[0]
        camera.location.y = -80
        look()
        assert sizes[2][0] < sizes[0][0]
        item.location.y = -76
        bpy.context.view_layer.update()
        look()
        assert sizes[3][0] > sizes[2][0]
        item.v3dg.opacity = 0.5
        look()
        assert sizes[4][1] != sizes[3][1]
        bpy.context.scene.v3dg.viewport_budget = 20
        look()
        assert 0 < sizes[5][0] <= 20
        assert watch.status() == f"{sizes[5][0]} gaussians of 1 instances in 1 data blocks"
        item.v3dg.bundle = os.path.abspath("moved.v3dg")
        watch.expect_change()
        look()
        assert "moved.v3dg: expected a bundle" in watch.status()
        bpy.context.scene.v3dg.follows = False
        item.v3dg.bundle = os.path.abspath("ball.v3dg")
        watch.expect_change()
        look()
        assert "moved.v3dg" in watch.status()
    finally:
        watch.viewports = found


@check
def what_is_not_in_view_shows_nothing_and_can_be_rendered():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    add_camera((0, -30, 0), (0, -60, 0))
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.render.resolution_x = 4
    scene.render.resolution_y = 4
    bpy.ops.render.render()
    assert size(bpy.context.object) == 0
    scene.v3dg.culls = False
    bpy.ops.render.render()
    assert size(bpy.context.object) > 0


@check
def a_cut_stays_when_nothing_changes():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    add_camera((0, -3, 1))
    show.show_render(bpy.context.scene, depsgraph())
    block = bpy.context.object.data
    show.show_render(bpy.context.scene, depsgraph())
    assert bpy.context.object.data == block


@check
def a_scene_comes_back_as_it_was_saved():
    first = make_bundle("first.v3dg")
    second = make_bundle("second.v3dg", seed=1, sh_degree=0)
    rng = np.random.default_rng(3)
    scene = v3dg.Scene()
    scene.up = "y"
    scene.add(first, rng.normal(size=(4, 3)), rng.normal(size=(4, 4)), [0.5, 1, 2, 3])
    scene.add(second, (5, 6, 7), importance=2, opacity=0.25, tint=(0.5, 1, 2), environment=3)
    view = v3dg.Camera.look_at((0, 3, 20), (0, 0, 0), (0, 1, 0), width=200, height=100)
    v3dg.write_scene("in.json", scene, cameras={"front": view})
    bpy.ops.v3dg.open(filepath=os.path.abspath("in.json"))
    os.makedirs("below", exist_ok=True)
    bpy.ops.v3dg.save_scene(filepath=os.path.abspath("below/out.json"))
    saved, cameras = v3dg.read_scene("below/out.json")
    assert saved.up == "z"
    upright = v3dg.Scene()
    upright.add_scene(scene, up="z")
    order = np.lexsort(np.round(saved.positions, 4).T)
    expected_order = np.lexsort(np.round(upright.positions, 4).T)
    np.testing.assert_allclose(
        saved.positions[order], upright.positions[expected_order], rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(saved.rotations[order], upright.rotations[expected_order], atol=2e-6)
    for name in ("scales", "importance", "opacity", "tint", "environments"):
        np.testing.assert_allclose(
            getattr(saved, name)[order], getattr(upright, name)[expected_order], rtol=1e-6
        )
    # The camera shows the same view as before, at the size of the render.
    assert list(cameras) == ["front"]
    np.testing.assert_allclose(cameras["front"].K, view.K, rtol=1e-5)
    seen = in_view(cameras["front"], saved.positions[order])
    expected_seen = in_view(view, scene.positions[expected_order])
    np.testing.assert_allclose(seen, expected_seen, atol=1e-4)


def in_view(camera, points):
    return points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]


@check
def empties_and_copies_are_saved():
    path = make_bundle("ball.v3dg")
    bpy.ops.v3dg.open(filepath=path)
    source = bpy.context.object
    empties = []
    for number in range(3):
        empty = bpy.data.objects.new("Empty", None)
        empty.location = (number, 10, 0)
        bpy.context.collection.objects.link(empty)
        empty.select_set(True)
        empties.append(empty)
    bpy.context.view_layer.update()
    bpy.ops.v3dg.place()
    assert len(world.instances(bpy.context.scene)) == 4
    # An empty with a bundle is an instance of the scene file, too.
    empties[2].v3dg.bundle = path
    # A collection is placed twice, and the collection itself is not rendered.
    collection = bpy.data.collections.new("parts")
    bpy.context.scene.collection.children.link(collection)
    part = world.new_instance(path, mathutils.Matrix.Translation((0, 0, 5)), collection)
    part.hide_render = True
    for number in range(2):
        copies = bpy.data.objects.new("copies", None)
        copies.instance_type = "COLLECTION"
        copies.instance_collection = collection
        copies.location = (0, 20 + number, 0)
        bpy.context.collection.objects.link(copies)
    bpy.context.view_layer.update()
    operators.save_scene(bpy.context, "out.json")
    positions = sorted(map(tuple, np.round(v3dg.Scene.load("out.json").positions, 4).tolist()))
    assert positions == [
        (0, 0, 0),
        (0, 10, 0),
        (0, 20, 5),
        (0, 21, 5),
        (1, 10, 0),
        (2, 10, 0),
        (2, 10, 0),
    ]
    assert source.data is not None


def scatter(source, points):
    """Add an object that places copies of another one at points, by geometry nodes."""
    mesh = bpy.data.meshes.new("points")
    mesh.from_pydata(points, [], [])
    item = bpy.data.objects.new("scatter", mesh)
    bpy.context.collection.objects.link(item)
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start = tree.nodes.new("NodeGroupInput")
    copied = tree.nodes.new("GeometryNodeObjectInfo")
    copied.inputs["Object"].default_value = source
    copied.inputs["As Instance"].default_value = True
    copies = tree.nodes.new("GeometryNodeInstanceOnPoints")
    end = tree.nodes.new("NodeGroupOutput")
    tree.links.new(start.outputs[0], copies.inputs["Points"])
    tree.links.new(copied.outputs["Geometry"], copies.inputs["Instance"])
    tree.links.new(copies.outputs[0], end.inputs[0])
    item.modifiers.new("scatter", "NODES").node_group = tree
    bpy.context.view_layer.update()
    return item


@check
def scattered_copies_are_saved_and_can_be_made_real():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    source = bpy.context.object
    points = [(float(number), 5.0, 0.0) for number in range(4)]
    item = scatter(source, points)
    operators.save_scene(bpy.context, "out.json")
    positions = sorted(map(tuple, v3dg.Scene.load("out.json").positions.tolist()))
    assert positions == [(0.0, 0.0, 0.0), *points]
    if not splats.has_splats():
        return  # the ellipsoids would become objects, too
    bpy.ops.object.select_all(action="DESELECT")
    item.select_set(state=True)
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.duplicates_make_real()
    bpy.data.objects.remove(item)
    bpy.context.view_layer.update()
    items = world.instances(bpy.context.scene)
    assert sorted(tuple(item.location) for item in items) == [(0, 0, 0), *points]
    add_camera((1.5, -10, 2), (1.5, 5, 0))
    shown = show.show_render(bpy.context.scene, depsgraph())
    assert shown.num_instances == 5
    operators.save_scene(bpy.context, "again.json")
    assert len(v3dg.Scene.load("again.json")) == 5


@check
def copies_show_what_the_nearest_of_them_needs():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    source = bpy.context.object
    source.hide_render = True
    source.hide_viewport = True
    scene = bpy.context.scene
    # The nearest copy is in view only in part.
    item = scatter(source, [(0.9, 0, 0), (0, 4, 0), (0, 9, 0), (30, 0, 0)])
    camera = add_camera((0, -2, 0))
    if not splats.has_splats():
        return
    scene.v3dg.tolerance_px2 = 30
    shown = show.show_render(scene, depsgraph())
    lens = views.render_camera(scene, camera, depsgraph())
    near = v3dg.Scene()
    near.add(source.v3dg.bundle, (0.9, 0, 0), up="z")
    cut = v3dg.select(near, lens, tolerance=30, cull=False)
    assert v3dg.select(near, lens, tolerance=30).num_gaussians < cut.num_gaussians
    assert size(source) == cut.num_gaussians
    assert shown.num_instances == 3
    assert shown.num_gaussians == 3 * size(source)
    for budget in (600, 90):
        scene.v3dg.render_budget = budget
        shown = show.show_render(scene, depsgraph())
        assert 0 < 3 * size(source) == shown.num_gaussians <= budget
    num_changes = watch._state.num_changes
    item.location.x = 1
    bpy.context.view_layer.update()
    assert watch._state.num_changes > num_changes


@check
def a_scene_without_instances_can_be_opened_shown_and_saved():
    v3dg.write_scene("empty.json", v3dg.Scene())
    bpy.ops.v3dg.open(filepath="empty.json")
    add_camera((0, -3, 0))
    bpy.ops.v3dg.update()
    assert watch.status() == "0 gaussians of 0 instances in 0 data blocks"
    bpy.ops.v3dg.save_scene(filepath=os.path.abspath("out.json"))
    assert len(v3dg.Scene.load("out.json")) == 0
    # Nothing is shown if all instances are hidden.
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    item = bpy.context.object
    item.hide_viewport = True
    item.hide_render = True
    view = views.render_camera(bpy.context.scene, bpy.context.scene.camera, depsgraph())
    assert show.show_viewport(bpy.context.scene, depsgraph(), view).num_gaussians == 0
    assert show.show_render(bpy.context.scene, depsgraph()).num_gaussians == 0


@check
def what_a_camera_loses_is_a_warning():
    scene = v3dg.Scene()
    scene.add(make_bundle("ball.v3dg"))
    plain = v3dg.Camera.look_at((0, -4, 0), (0, 0, 0), width=40, height=30)
    curved = v3dg.Camera(plain.viewmat, plain.K, 40, 30, distortion=(0.1, 0, 0, 0), model="OPENCV")
    oblong = v3dg.Camera(plain.viewmat, plain.K * [[1], [2], [1]], 40, 30)
    cameras = {"plain": plain, "curved": curved, "oblong": oblong}
    v3dg.write_scene("in.json", scene, cameras=cameras)
    warnings = operators.open_file(bpy.context, os.path.abspath("in.json"))
    assert [text.split(":")[0] for text in warnings] == ["curved", "oblong"]
    assert operators.save_scene(bpy.context, "out.json") == []
    bpy.data.objects["plain"].data.type = "ORTHO"
    (warning,) = operators.save_scene(bpy.context, "out.json")
    assert warning.startswith("plain: left out")
    assert sorted(v3dg.read_scene("out.json")[1]) == ["curved", "oblong"]


@check
def errors_are_reports():
    path = make_bundle("ball.v3dg")
    assert "missing.v3dg" in failure(bpy.ops.v3dg.open, filepath=os.path.abspath("missing.v3dg"))
    Path("broken.v3dg").write_bytes(b"no bundle")
    assert "broken.v3dg" in failure(bpy.ops.v3dg.open, filepath=os.path.abspath("broken.v3dg"))
    message = failure(bpy.ops.v3dg.open, filepath=os.path.abspath("asset.ply"))
    assert "asset.ply: expected a bundle (.v3dg) or a scene (.json)" in message
    bpy.ops.v3dg.open(filepath=path)
    item = bpy.context.object
    assert "camera: the scene has none" in failure(bpy.ops.v3dg.update)
    add_camera((0, -3, 0), type="PANO")
    assert "expected a perspective or orthographic camera, got PANO" in failure(bpy.ops.v3dg.update)
    add_camera((0, -3, 0))
    world.new_instance(path, mathutils.Matrix.Translation((0, 1, 0)), bpy.context.collection)
    bpy.context.scene.v3dg.render_budget = 1
    before = item.data
    assert "budget: expected at least" in failure(bpy.ops.v3dg.update)
    assert item.data == before
    for scale, problem in (((1, 2, 1), "a stretch"), ((-1, -1, -1), "a mirror")):
        item.scale = scale
        bpy.context.view_layer.update()
        message = failure(bpy.ops.v3dg.save_scene, filepath=os.path.abspath("refused.json"))
        assert item.name in message
        assert problem in message
        bpy.context.scene.v3dg.render_budget = 10_000
        bpy.ops.v3dg.update()
    assert not Path("refused.json").exists()


@check
def a_bundle_at_a_url_is_refused():
    scene = v3dg.Scene()
    scene.add(make_bundle("ball.v3dg"))
    path = v3dg.Bundle.path
    v3dg.Bundle.path = property(lambda bundle: "https://example.org/ball.v3dg")
    try:
        world.add_scene(scene, bpy.context.collection)
    except ValueError as error:
        message = str(error)
    finally:
        v3dg.Bundle.path = path
    assert "ball.v3dg: expected a bundle on this machine, got a URL" in message
    assert not world.instances(bpy.context.scene)


@check
def cameras_see_what_blender_sees():
    bpy.context.scene.render.resolution_x = 300
    bpy.context.scene.render.resolution_y = 200
    for lens in (
        {"lens": 35},
        {"lens": 20, "shift_x": 0.2, "shift_y": -0.1},
        {"lens": 50, "sensor_fit": "VERTICAL", "sensor_height": 20},
        {"type": "ORTHO", "ortho_scale": 4, "shift_x": 0.1, "shift_y": 0.05},
    ):
        camera = add_camera((2, -5, 3), (0.2, 0, 0.1), **lens)
        camera.scale = (2, 2, 2)
        graph = depsgraph()
        view = views.render_camera(bpy.context.scene, camera, graph)
        points = np.random.default_rng(0).normal(0, 0.5, (20, 3))
        rotated = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        pixels = (rotated @ view.K.T / rotated[:, 2:])[:, :2]
        scene = bpy.context.scene
        expected = [
            world_to_camera_view(scene, camera, mathutils.Vector(point))[:2] for point in points
        ]
        expected = np.array(expected) * (1, -1) + (0, 1)
        is_ortho = lens.get("type") == "ORTHO"
        # An orthographic view is replaced by a distant pinhole.
        np.testing.assert_allclose(
            pixels, expected * (view.width, view.height), atol=2.5 if is_ortho else 2e-3
        )


@check
def a_render_shows_the_cut_of_its_camera_in_the_colours_of_the_asset():
    # Before 5.3, colours do not depend on the direction of view.
    sh_degree = 2 if splats.has_splats() else 0
    path = make_bundle("ball.v3dg", count=400, sh_degree=sh_degree, opacity=0.999)
    bpy.ops.v3dg.open(filepath=path)
    scene = bpy.context.scene
    item = bpy.context.object
    item.rotation_euler = (0.4, -0.8, 1.2)
    camera = add_camera((0, -2.2, 0.4))
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 8
    scene.cycles.use_denoising = False
    scene.render.resolution_x = 40
    scene.render.resolution_y = 30
    scene.view_settings.view_transform = "Standard"
    scene.v3dg.tolerance_px2 = 0
    scene.v3dg.render_budget = 300
    before = size(item)
    scene.render.filepath = os.path.abspath("render.png")
    bpy.ops.render.render(write_still=True)
    assert before < size(item) <= 300
    picture = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(picture.pixels[:], np.float32).reshape(30, 40, 4)[::-1, :, :3]
    lens = views.render_camera(scene, camera, depsgraph())
    expected = v3dg.Scene()
    matrix = np.array(item.matrix_world, np.float64)[None]
    world.add_instances(expected, [item], world.nearest_similarities(matrix))
    image = v3dg.render(expected, lens, budget=300, device="cpu")
    truth = np.clip(image.color, 0, 1)
    # Transparent pixels differ: v3dg blends in sRGB, and Blender in linear colours.
    is_opaque = image.alpha.reshape(30, 40) > 0.97
    assert is_opaque.sum() > 200
    means = pixels[is_opaque].mean(0)
    np.testing.assert_allclose(means, truth[is_opaque].mean(0), atol=0.06)
    correlation = np.corrcoef(pixels.mean(2).ravel(), truth.mean(2).ravel())[0, 1]
    assert correlation > 0.9, correlation


@check
def each_frame_of_an_animation_has_its_own_cut():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    scene = bpy.context.scene
    item = bpy.context.object
    camera = add_camera((0, -60, 0))
    camera.keyframe_insert("location", frame=1)
    camera.location = (0, -3, 0)
    camera.keyframe_insert("location", frame=2)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.render.resolution_x = 4
    scene.render.resolution_y = 4
    scene.frame_start = 1
    scene.frame_end = 2
    scene.v3dg.render_budget = 1_000_000
    sizes = []
    bpy.app.handlers.render_post.append(lambda *_: sizes.append(size(item)))
    scene.render.filepath = os.path.abspath("frame")
    scene.frame_set(1)
    bpy.ops.render.render(animation=True)
    bpy.app.handlers.render_post.clear()
    expected = []
    for frame in (1, 2):
        scene.frame_set(frame)
        expected.append(show.show_render(scene, depsgraph()).num_gaussians)
    assert expected[0] < expected[1]
    assert sizes == expected, (sizes, expected)


@check
def a_changed_bundle_is_opened_again():
    path = make_bundle("ball.v3dg", count=1000)
    bpy.ops.v3dg.open(filepath=path)
    item = bpy.context.object
    add_camera((0, -2, 0))
    before = show.show_render(bpy.context.scene, depsgraph())
    block = item.data.name
    make_bundle("ball.v3dg", count=500, seed=5)
    after = show.show_render(bpy.context.scene, depsgraph())
    assert after.num_gaussians < before.num_gaussians
    assert item.data.name != block


@check
def a_saved_file_opens_with_its_cut_and_its_settings():
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    add_camera((0, -3, 0))
    bpy.context.scene.v3dg.render_budget = 777
    shown = show.show_render(bpy.context.scene, depsgraph())
    bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath("world.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=os.path.abspath("world.blend"))
    (item,) = world.instances(bpy.context.scene)
    assert size(item) == shown.num_gaussians
    assert bpy.context.scene.v3dg.render_budget == 777
    assert show.show_render(bpy.context.scene, depsgraph()) == shown


@check
def a_missing_package_is_named():
    modules = {name: sys.modules[name] for name in list(sys.modules) if "v3dg" in name}
    message = ""
    try:
        for name in modules:
            del sys.modules[name]
        sys.modules["v3dg"] = None  # `import v3dg` then fails
        importlib.import_module("v3dg_blender")
    except ImportError as error:
        message = str(error)
    finally:
        sys.modules.update(modules)
    assert "Blender's Python cannot import the package v3dg" in message


@check
def the_addon_can_be_switched_off_and_on():
    v3dg_blender.unregister()
    assert not hasattr(bpy.types.Object, "v3dg")
    v3dg_blender.register()
    bpy.ops.v3dg.open(filepath=make_bundle("ball.v3dg"))
    assert watch.current_viewport() is None


def main():
    v3dg_blender.register()
    results = {}
    for function in CHECKS:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        watch.expect_change()
        try:
            function()
            results[function.__name__] = ""
        except Exception:
            results[function.__name__] = traceback.format_exc()
    v3dg_blender.unregister()
    Path("results.json").write_text(json.dumps(results))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        CHECKS[:] = [function for function in CHECKS if function.__name__ in sys.argv[1:]]
    main()
