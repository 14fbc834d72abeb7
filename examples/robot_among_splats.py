"""Draws a robot of triangles among gaussians. A small z-buffer renderer draws the
robot, and v3dg combines it with the gaussians, with antialiased edges and ids.

    python examples/robot_among_splats.py --output robot.png

A second picture, robot_channels.png, shows depth, normals, instances and labels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import tyro

import v3dg
from v3dg.cameras import Axis
from v3dg.donut import make_donut
from v3dg.pictures import write_picture
from v3dg.render import Channel
from v3dg.rotations import rotation_from_quaternion, turn_between

Floats = npt.NDArray[np.float64]
Light = Literal["display", "linear"]

SAMPLES = 4  # number of z-buffer samples of a pixel along each axis
SUN = np.array([0.4, -0.5, 0.77])  # direction to the light
FLOOR_LABEL = 1
ROBOT_LABEL = 2
FOOD_LABEL = 3
# first id of the robot's parts, larger than the ids of the scene's instances
FIRST_PART = 1000
CHANNELS: tuple[Channel, ...] = ("depth", "median_depth", "normal", "instance", "label", "weight")


@dataclass
class Config:
    """Draw a robot of triangles among gaussians."""

    output: Path = Path("robot.png")
    """Picture to write."""
    assets: tuple[Path, ...] = ()
    """More assets, which are placed behind the robot."""
    up: Axis = "z"
    """Axis that is up in these assets."""
    gaussians: int = 30_000
    """Number of gaussians of a donut."""
    steps: int = 0
    """Number of steps of the fit of each level."""
    size: tuple[int, int] = (960, 640)
    """Width and height of the picture in px."""
    light: Light = "linear"
    """Colour space in which robot and gaussians are mixed."""


@dataclass(frozen=True)
class Part:
    """Triangles (T, 3, 3) in the world, their colour and their label."""

    triangles: Floats
    albedo: tuple[float, float, float]  # in linear light
    label: int = ROBOT_LABEL


def box(center: tuple[float, float, float], size: tuple[float, float, float]) -> Floats:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    points = corners * size + np.array(center)
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return np.array([points[[a, b, c]] for side in sides for a, b, c in _halves(side)])


def _halves(side: tuple[int, int, int, int]) -> tuple[tuple[int, int, int], ...]:
    first, second, third, fourth = side
    return ((first, second, third), (first, third, fourth))


def limb(start: Floats, end: Floats, radius: float, end_radius: float) -> Floats:
    """Return a closed cone between two points."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * math.pi, 33)
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    low = start + radius * ring
    high = end + end_radius * ring
    triangles = []
    for a, b, c, d in zip(low[:-1], low[1:], high[:-1], high[1:], strict=True):
        triangles += [[a, b, d], [a, d, c], [start, b, a], [end, c, d]]
    return np.array(triangles)


def ball(center: Floats, radius: float) -> Floats:
    polar = np.linspace(0, math.pi, 17)
    azimuth = np.linspace(0, 2 * math.pi, 33)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    points = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    points = center + radius * points
    first = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:]], axis=2)
    second = np.stack([points[:-1, :-1], points[1:, 1:], points[:-1, 1:]], axis=2)
    return np.concatenate([first.reshape(-1, 3, 3), second.reshape(-1, 3, 3)])


def robot() -> list[Part]:
    """Return the parts of an arm on a base. Its forearm passes through a donut."""
    joints = np.array([[0, 0, 0.9], [0.1, 0, 2.3], [1.5, -0.1, 1.55], [2.15, -0.15, 1.2]])
    steel = (0.55, 0.57, 0.6)
    orange = (0.85, 0.23, 0.03)
    dark = (0.03, 0.035, 0.04)
    shoulder, elbow, wrist, hand = joints
    parts = [
        Part(box((0, 0, -0.05), (9.0, 6.5, 0.1)), (0.24, 0.26, 0.28), FLOOR_LABEL),
        Part(limb(np.zeros(3), np.array([0, 0, 0.45]), 0.62, 0.5), dark),
        Part(limb(np.array([0, 0, 0.45]), shoulder, 0.34, 0.3), steel),
        Part(ball(shoulder, 0.36), dark),
        Part(limb(shoulder, elbow, 0.22, 0.18), orange),
        Part(ball(elbow, 0.27), dark),
        Part(limb(elbow, wrist, 0.17, 0.12), orange),
        Part(ball(wrist, 0.17), dark),
        Part(limb(wrist, hand, 0.1, 0.1), steel),
    ]
    for side in (-1, 1):
        root = hand + np.array([0, 0.14 * side, 0])
        parts.append(Part(limb(hand, root, 0.07, 0.07), dark))
        parts.append(Part(limb(root, root + np.array([0.32, 0, -0.17]), 0.05, 0.03), steel))
    return parts


@dataclass
class Samples:
    """A z-buffer with SAMPLES x SAMPLES samples per pixel."""

    depth: Floats  # (h, w); infinite where nothing is drawn
    color: Floats  # (h, w, 3) linear
    normal: Floats  # (h, w, 3) in the axes of the camera
    part: npt.NDArray[np.int32]  # (h, w)


def draw_meshes(parts: list[Part], camera: v3dg.Camera, light: Light) -> v3dg.MeshLayer:
    """Draw triangles by a z-buffer, and average the samples of each pixel."""
    height = camera.height * SAMPLES
    width = camera.width * SAMPLES
    samples = Samples(
        np.full((height, width), np.inf),
        np.zeros((height, width, 3)),
        np.zeros((height, width, 3)),
        np.zeros((height, width), np.int32),
    )
    for number, part in enumerate(parts):
        to_view = camera.viewmat[:3, :3]
        view = part.triangles @ to_view.T + camera.viewmat[:3, 3]
        for triangle, in_world in zip(view, part.triangles, strict=True):
            if (triangle[:, 2] > camera.near).all():
                _draw_triangle(samples, triangle, in_world, part, number, camera)
    return _layer_of(samples, parts, camera, light)


def _draw_triangle(
    samples: Samples,
    view: Floats,
    in_world: Floats,
    part: Part,
    number: int,
    camera: v3dg.Camera,
) -> None:
    pixels = (view[:, :2] / view[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)) * SAMPLES
    height, width = samples.depth.shape
    x0, y0 = np.clip(np.floor(pixels.min(0)).astype(int), 0, (width, height))
    x1, y1 = np.clip(np.ceil(pixels.max(0)).astype(int) + 1, 0, (width, height))
    (ax, ay), (bx, by), (cx, cy) = pixels
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area == 0 or x0 >= x1 or y0 >= y1:
        return
    y, x = np.mgrid[y0:y1, x0:x1] + 0.5
    second = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
    third = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
    first = 1 - second - third
    inverse = first / view[0, 2] + second / view[1, 2] + third / view[2, 2]
    is_inside = (first >= 0) & (second >= 0) & (third >= 0)
    depth = np.where(is_inside, 1 / np.where(inverse == 0, 1, inverse), np.inf)
    place = np.s_[y0:y1, x0:x1]
    is_nearest = depth < samples.depth[place]
    normal = np.cross(in_world[1] - in_world[0], in_world[2] - in_world[0])
    normal /= np.linalg.norm(normal)
    if (camera.viewmat[:3, :3] @ normal) @ view[0] > 0:
        normal = -normal
    shading = 0.25 + 0.9 * max(0.0, float(normal @ SUN))
    samples.depth[place][is_nearest] = depth[is_nearest]
    samples.color[place][is_nearest] = np.array(part.albedo) * shading
    samples.normal[place][is_nearest] = camera.viewmat[:3, :3] @ normal
    samples.part[place][is_nearest] = number


def _layer_of(
    samples: Samples, parts: list[Part], camera: v3dg.Camera, light: Light
) -> v3dg.MeshLayer:
    """Average the samples of each pixel.

    The ids of a pixel are those of its nearest sample.
    """

    def of_pixels(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        shape = (camera.height, SAMPLES, camera.width, SAMPLES, *values.shape[2:])
        blocks: npt.NDArray[Any] = values.reshape(shape).swapaxes(1, 2)
        samples_of_pixels: npt.NDArray[Any] = blocks.reshape(
            camera.height, camera.width, SAMPLES * SAMPLES, *values.shape[2:]
        )
        return samples_of_pixels

    depths = of_pixels(samples.depth)
    is_hit = np.isfinite(depths)
    count = is_hit.sum(axis=-1)
    share = is_hit / np.maximum(count, 1)[..., None]
    color = (share[..., None] * of_pixels(samples.color)).sum(axis=2)
    if light == "display":
        color = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    nearest = np.argmin(depths, axis=-1)[..., None]
    part = np.take_along_axis(of_pixels(samples.part), nearest, axis=-1)[..., 0]
    return v3dg.MeshLayer(
        color=color,
        depth=(share * np.where(is_hit, depths, 0)).sum(axis=-1),
        coverage=count / SAMPLES**2,
        normal=(share[..., None] * of_pixels(samples.normal)).sum(axis=2),
        instance=FIRST_PART + part,
        label=np.array([part.label for part in parts])[part],
        light=light,
    )


def make_scene(config: Config) -> v3dg.Scene:
    """Return a scene of donuts on the floor and one donut on the forearm. More assets
    are behind the robot."""
    build = v3dg.BuildConfig(steps=config.steps)
    donut = v3dg.build_bundle(make_donut(config.gaussians), config=build)
    scene = v3dg.Scene()
    axis = np.array([1.4, -0.1, -0.75])
    axis /= np.linalg.norm(axis)
    # half a turn about this vector maps z to the axis
    half = np.array([0.0, 0, 1]) + axis
    on_arm = (half[2], -half[1], half[0], 0.0)
    flat = (1.0, 0, 0, 0)
    scene.add(
        donut,
        positions=[[0.8, -0.05, 1.93], [1.9, -1.3, 0.2], [-1.3, -1.1, 0.3], [0.0, -1.0, 0.25]],
        quaternions=[on_arm, flat, (0.8, 0.6, 0, 0), flat],
        scales=[0.45, 0.55, 0.55, 0.6],
        label=FOOD_LABEL,
    )
    for number, path in enumerate(config.assets):
        asset = v3dg.read_asset(path)
        turn = turn_between(config.up, "z")
        points = asset.means @ rotation_from_quaternion(turn).T
        low, high = np.percentile(points, (1, 99), axis=0)
        scale = 2.2 / (high - low).max()
        middle = np.append((low[:2] + high[:2]) / 2, low[2])
        place = np.array([-2.3 + 3.6 * number, 1.7, 0]) - scale * middle
        bundle = v3dg.build_bundle(asset, config=build)
        scene.add(bundle, place, turn, scale, label=FOOD_LABEL + 1 + number)
    return scene


def main(config: Config) -> v3dg.RenderedImage:
    """Draw robot and gaussians, and write the pictures."""
    width, height = config.size
    camera = v3dg.Camera.look_at(
        (1.6, -6.2, 3.1), (0.45, 0, 1.0), fov_x=0.9, width=width, height=height
    )
    mesh = draw_meshes(robot(), camera, config.light)
    image = v3dg.render(
        make_scene(config),
        camera,
        channels=CHANNELS,
        mesh=mesh,
        background=(0.75, 0.83, 0.9),
        device="cpu",
    )
    image.save(config.output)
    channels = config.output.with_name(f"{config.output.stem}_channels.png")
    write_picture(channels, channels_as_colors(image))
    return image


def channels_as_colors(image: v3dg.RenderedImage) -> npt.NDArray[np.float32]:
    """Return depth, normals, instances and labels side by side, as colours."""
    depth = np.where(image.depth > 0, image.depth, np.inf)
    near = 2.0 / depth
    palette = np.random.default_rng(1).uniform(0.2, 1, (4096, 3))
    palette[-1] = 0
    rows = [
        [np.repeat(near[..., None], 3, axis=-1), (image.normal * (1, -1, -1) + 1) / 2],
        [palette[image.instance], palette[image.label]],
    ]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows]).astype(np.float32)


if __name__ == "__main__":
    main(tyro.cli(Config))
