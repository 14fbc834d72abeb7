"""Makes blender.jpg: a field of donuts and oaks, opened and rendered by the add-on.

    blender/bin/python docs/images/make_blender.py donut.v3dg oak.v3dg blender.jpg

The script needs a Python with bpy 5.3, and v3dg with its dependencies.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "integrations" / "blender"))

import bpy
import numpy as np

import v3dg
import v3dg_blender
from v3dg_blender import watch

ROWS = 50
SPACING = 1.2
OAK_SHARE = 0.22
BUDGET = 400_000
SAMPLES = 20
GREEN = (0.12, 0.16, 0.06, 1.0)
SKY = (0.55, 0.7, 0.9, 1.0)


def write_world(path: Path, donut: str, oak: str) -> None:
    """Write a scene with an instance near each point of a grid."""
    rng = np.random.default_rng(2)
    columns, rows = np.meshgrid(np.arange(ROWS) - ROWS / 2, np.arange(ROWS))
    places = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(ROWS**2)])
    places[:, :2] += rng.uniform(-0.3, 0.3, (ROWS**2, 2))
    places *= SPACING
    half_angles = rng.uniform(0, np.pi, ROWS**2)
    quaternions = np.zeros((ROWS**2, 4))
    quaternions[:, 0] = np.cos(half_angles)
    quaternions[:, 3] = np.sin(half_angles)
    scales = rng.uniform(0.8, 1.2, ROWS**2)
    is_oak = rng.random(ROWS**2) < OAK_SHARE
    places[is_oak, 2] = -0.18  # the trunk begins above the origin of the asset
    scene = v3dg.Scene()
    scene.up = "z"
    for bundle, is_placed, size in ((oak, is_oak, 0.11), (donut, ~is_oak, 2.2)):
        scene.add(
            v3dg.Bundle.open(bundle),
            places[is_placed],
            quaternions[is_placed],
            size * scales[is_placed],
        )
    camera = v3dg.Camera.look_at(
        (0.3, -2.2, 1.15), (0.1, 3, 0.15), fov_x=0.9, width=600, height=375
    )
    v3dg.write_scene(path, scene, cameras={"field": camera})


def add_ground_and_light(scene: bpy.types.Scene) -> None:
    """Add a plane on which the gaussians cast shadows, a sun and a sky."""
    corners = [(-300, -50, 0), (300, -50, 0), (300, 600, 0), (-300, 600, 0)]
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("ground")
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = GREEN
    shader.inputs["Roughness"].default_value = 1.0
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("ground", mesh))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 2.0
    sun.rotation_euler = (0.6, 0.3, 0.0)
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = SKY


def main(donut: str, oak: str, output: str) -> None:
    v3dg_blender.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "field.json"
        write_world(path, donut, oak)
        bpy.ops.v3dg.open(filepath=str(path))
        scene = bpy.context.scene
        scene.v3dg.render_budget = BUDGET
        add_ground_and_light(scene)
        scene.view_settings.view_transform = "Standard"
        scene.render.engine = "CYCLES"
        scene.cycles.samples = SAMPLES
        scene.render.image_settings.file_format = "JPEG"
        scene.render.image_settings.quality = 88
        scene.render.filepath = str(Path(output).resolve())
        bpy.ops.render.render(write_still=True)
    print(watch.status())


if __name__ == "__main__":
    main(*sys.argv[1:])
