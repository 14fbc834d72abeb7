"""Worlds of about 100 million gaussians, like the four scenes of the V3DG paper, from
generated assets.

A world defines where assets are placed. Making the assets, building their bundles and
composing the scene are separate steps:

    world = worlds.forest(instances=60, num_gaussians=20_000)
    bundles = {
        name: v3dg.build_bundle(asset.make()) for name, asset in world.assets.items()
    }
    scene = worlds.scene_of(world, bundles)
    image = v3dg.render(scene, world.cameras()["000_camera_0"])
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.worlds.paper_cameras import trajectories
from benchmarks.worlds.procedural import TREE_KINDS, make_donut, make_person, make_temple, make_tree
from benchmarks.worlds.procedural.donut import RING, TUBE
from benchmarks.worlds.rings import Pile
from v3dg._device import Device
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, Floats
from v3dg.gaussians import Gaussians
from v3dg.io import read_asset, write_asset
from v3dg.levels import BuildConfig, build_file
from v3dg.scene import Scene
from v3dg.scene.file import write_scene


@dataclass(frozen=True)
class Asset:
    """A generated asset: the function that makes it, and its number of gaussians."""

    make: Callable[[], Gaussians]
    num_gaussians: int


@dataclass(frozen=True)
class Placement:
    """The poses of the I instances of one asset.

    Attributes:
        positions: (I, 3) positions in world units.
        quaternions: (I, 4) rotations as w, x, y, z.
        scales: (I,) scale factors.
    """

    positions: Floats
    quaternions: Floats
    scales: Floats

    def __len__(self) -> int:
        return len(self.scales)


@dataclass(frozen=True)
class World:
    """Assets and their placements, by the names of the assets.

    Attributes:
        extent: Distance of the farthest cameras from the origin, in world units.
    """

    name: str
    assets: Mapping[str, Asset]
    placements: Mapping[str, Placement]
    extent: float

    @property
    def num_instances(self) -> int:
        return sum(len(placement) for placement in self.placements.values())

    @property
    def num_gaussians(self) -> int:
        """The number of gaussians of all instances at full detail."""
        return sum(
            len(self.placements[name]) * asset.num_gaussians for name, asset in self.assets.items()
        )

    def cameras(self, *, width: int = 1920, height: int = 1080) -> dict[str, Camera]:
        """Return the paper's 400 cameras around the origin, at distances up to the
        world's extent."""
        return trajectories((0.0, 0.0, 0.0), self.extent, width=width, height=height)


def scene_of(world: World, bundles: Mapping[str, Bundle]) -> Scene:
    """Place bundles as a world defines.

    Args:
        bundles: A bundle for each of the world's assets, by the asset's name.

    Raises:
        ValueError: A bundle is missing.
    """
    missing = [name for name in world.placements if name not in bundles]
    if missing:
        raise ValueError(
            f"bundles: expected one for each asset of {world.name}, got none for {missing[0]}"
        )
    scene = Scene()
    for name, placement in world.placements.items():
        scene.add(bundles[name], placement.positions, placement.quaternions, placement.scales)
    return scene


def donut_sea(instances: int = 2048, num_gaussians: int = 45_624, *, seed: int = 0) -> World:
    """Make a pile of donuts that lie on the ground after a fall, with scales from 3/4
    to 1.

    Args:
        instances: Number of donuts.
        num_gaussians: Number of gaussians of the single asset.

    Raises:
        ValueError: ``instances`` is below 1.
    """
    pile = donut_shower(instances, seed=seed)
    for _ in range(_FALL_STEPS):
        pile.step()
    pile.relax()
    placement = Placement(pile.positions, pile.quaternions, pile.scales)
    reach = float(np.percentile(np.hypot(*pile.positions[:, :2].T), 90)) + RING + TUBE
    asset = Asset(partial(make_donut, num_gaussians, seed=seed), num_gaussians)
    return World("donut_sea", {"donut": asset}, {"donut": placement}, 2.6 * reach)


# Number of steps of 1/60 s after which the highest donuts have fallen and the pile is
# at rest.
_FALL_STEPS = 50


def donut_shower(instances: int, *, seed: int = 0, layers: float = 4.0, gap: float = 0.03) -> Pile:
    """Place donuts in the air without contacts, in about `layers` layers, so that they
    can fall.

    Args:
        gap: Free space between donuts of full size, at any rotation.
    """
    if instances < 1:
        raise ValueError(f"instances: expected at least 1, got {instances}")
    rng = np.random.default_rng(seed)
    pitch = 2 * (RING + TUBE) + gap
    a_layer = max(1, round(instances / layers))
    reach = int(np.ceil(np.sqrt(a_layer))) + 2
    i, j = (
        x.ravel() for x in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    )
    plane = pitch * np.stack([i + 0.5 * j, np.sqrt(0.75) * j], -1)
    plane = plane[np.argsort(np.hypot(*plane.T), kind="stable")[:a_layer]]
    layer, cell = np.divmod(np.arange(instances), a_layer)
    # A layer lies above the gaps of the layer below, as in a close packing, and is
    # slightly rotated.
    shift = pitch * np.array([0.5, np.sqrt(1 / 12)]) * (layer % 2)[:, None]
    jitter = rng.uniform(-0.4, 0.4, (instances, 3)) * gap / np.sqrt(3)
    height = RING + TUBE + gap + layer * pitch
    positions = np.column_stack([plane[cell] + shift, height]) + jitter
    quaternions = rng.standard_normal((instances, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Pile(positions, quaternions, rng.uniform(0.75, 1.0, instances), ring=RING, tube=TUBE)


def forest(instances: int = 400, num_gaussians: int = 315_630, *, seed: int = 0) -> World:
    """Make a forest of eight kinds of trees with random rotations and sizes, whose
    crowns hardly touch.

    Args:
        num_gaussians: Mean number of gaussians per asset; the eight kinds have 0.6 to
            1.4 times the mean.
    """
    shares = np.linspace(0.6, 1.4, len(TREE_KINDS))[
        np.random.default_rng([seed, 1]).permutation(len(TREE_KINDS))
    ]
    counts = [round(num_gaussians * share) for share in shares]
    assets = {
        kind: Asset(partial(make_tree, count, kind=kind, seed=seed), count)
        for kind, count in zip(TREE_KINDS, counts, strict=True)
    }
    radii = dict(zip(TREE_KINDS, (4.2, 3.6, 2.8, 3.4, 3.9, 1.5, 2.4, 2.8), strict=True))
    return _scattered("forest", assets, radii, instances, (0.75, 1.25), seed)


def temples(instances: int = 100, num_gaussians: int = 1_350_487, *, seed: int = 0) -> World:
    """Make a plain of temples with random rotations and sizes, which do not touch.

    Args:
        num_gaussians: Number of gaussians of the single asset.
    """
    asset = Asset(partial(make_temple, num_gaussians, seed=seed), num_gaussians)
    return _scattered("temples", {"temple": asset}, {"temple": 15.8}, instances, (0.7, 1.2), seed)


def crowd(
    instances: int = 400, num_gaussians: int = 343_274, *, persons: int = 16, seed: int = 0
) -> World:
    """Make a crowd of persons in a square grid. All look in one direction, and their
    soles are at z = -0.85.

    Args:
        num_gaussians: Number of gaussians of each asset.
        persons: Number of different persons.

    Raises:
        ValueError: ``instances`` or ``persons`` is below 1.
    """
    for name, value in (("instances", instances), ("persons", persons)):
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    persons = min(persons, instances)
    pitch, side = 1.2, int(np.ceil(np.sqrt(instances)))
    row, column = np.divmod(np.arange(instances), side)
    half = 0.5 * (side - 1)
    # The cameras look at the origin. The origin is at half of the persons' height,
    # because there is nothing to see between their feet.
    heights = np.full(instances, -0.85)
    positions = np.stack([pitch * (column - half), pitch * (row - half), heights], -1)
    # All persons occur equally often, and neighbours are different persons.
    who = np.concatenate(
        [
            np.random.default_rng([seed, i]).permutation(persons)
            for i in range(-(-instances // persons))
        ]
    )
    assets, placements = {}, {}
    for person in range(persons):
        name = f"person_{person:02}"
        at = positions[who[:instances] == person]
        assets[name] = Asset(
            partial(make_person, num_gaussians, seed=1000 * seed + person), num_gaussians
        )
        placements[name] = Placement(
            at, np.tile([1.0, 0.0, 0.0, 0.0], (len(at), 1)), np.ones(len(at))
        )
    return World("crowd", assets, placements, 2.0 * pitch * max(half, 1.0))


def _scattered(
    name: str,
    assets: dict[str, Asset],
    radii: Mapping[str, float],
    instances: int,
    scales: tuple[float, float],
    seed: int,
) -> World:
    """Place assets on the plane one after the other, at random positions where they
    touch no asset placed before."""
    if instances < 1:
        raise ValueError(f"instances: expected at least 1, got {instances}")
    rng = np.random.default_rng(seed)
    names = list(assets)
    which = np.concatenate(
        [rng.permutation(len(names)) for _ in range(-(-instances // len(names)))]
    )[:instances]
    size = rng.uniform(*scales, instances)
    room = size * np.array([radii[names[k]] for k in which])
    # Discs that are placed at random one after the other cover about this fraction of
    # the plane.
    extent = np.sqrt((room**2).sum() / 0.50)
    places = np.zeros((instances, 2))
    for i in range(1, instances):
        places[i] = _clear_place(places[:i], room[:i], room[i], extent, rng)
    yaw = rng.uniform(0, 2 * np.pi, instances)
    quaternions = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], -1)
    positions = np.column_stack([places, np.zeros(instances)])
    placements = {
        asset: Placement(positions[which == k], quaternions[which == k], size[which == k])
        for k, asset in enumerate(names)
        if (which == k).any()
    }
    assets = {asset: assets[asset] for asset in placements}
    return World(name, assets, placements, 2.0 * float((np.hypot(*places.T) + room).max()))


def _clear_place(
    places: npt.NDArray[np.float64],
    room: npt.NDArray[np.float64],
    radius: float,
    extent: float,
    rng: np.random.Generator,
) -> npt.NDArray[np.float64]:
    """Return a random position where a disc touches no other disc. The search area
    grows until there is one."""
    while True:
        r, a = extent * np.sqrt(rng.random(400)), rng.uniform(0, 2 * np.pi, 400)
        tried = np.stack([r * np.cos(a), r * np.sin(a)], -1)
        apart = np.linalg.norm(tried[:, None] - places, axis=-1) - room
        clear = np.flatnonzero(apart.min(axis=1) > radius)
        if len(clear):
            return np.asarray(tried[clear[0]])
        extent *= 1.1


WORLDS: dict[str, Callable[..., World]] = {
    "donut_sea": donut_sea,
    "forest": forest,
    "temples": temples,
    "crowd": crowd,
}
SMALL: dict[str, dict[str, int]] = {
    "donut_sea": {"instances": 256, "num_gaussians": 15_000},
    "forest": {"instances": 40, "num_gaussians": 20_000},
    "temples": {"instances": 12, "num_gaussians": 100_000},
    "crowd": {"instances": 64, "num_gaussians": 20_000, "persons": 4},
}
"""Arguments of `WORLDS` for small worlds, which a CPU builds in one or two minutes."""


def write_world(
    world: World,
    folder: str | os.PathLike[str],
    *,
    config: BuildConfig | None = None,
    seed: int = 0,
    device: str | Device = "auto",
    resume: bool = False,
    progress: bool = True,
) -> Path:
    """Make a world's assets, build their bundles, and write the assets, the bundles,
    and a scene file with cameras.

    Args:
        folder: Folder for ASSET.ply and ASSET.v3dg of each asset and for WORLD.json. It
            is created if it does not exist.
        config: Settings of the builds; None for the defaults of `build_bundle`.
        seed: Seed of the builds.
        resume: Whether to keep the bundles and finished levels of an interrupted call.

    Returns:
        The path of the scene file.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; a call with `resume` continues.
        ValueError, RuntimeError, OSError, MemoryError: As for `build_bundle`.
    """
    from tqdm import tqdm

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    config = config or BuildConfig()
    bundles = {}
    for name, asset in tqdm(
        world.assets.items(), desc=world.name, unit="asset", disable=not progress
    ):
        gaussians = asset.make()
        asset_path, bundle_path = folder / f"{name}.ply", folder / f"{name}.v3dg"
        if not (resume and asset_path.is_file() and _is_same(read_asset(asset_path), gaussians)):
            write_asset(asset_path, gaussians)
        bundles[name], _ = build_file(
            asset_path,
            bundle_path,
            asset=gaussians,
            config=config,
            seed=seed,
            device=device,
            resume=resume,
            progress=progress,
            quality="draft",
        )
    path = folder / f"{world.name}.json"
    paths = [f"{name}.v3dg" for name in world.placements]
    write_scene(path, scene_of(world, bundles), paths, world.cameras())
    return path


def _is_same(read: Gaussians, made: Gaussians) -> bool:
    """Return whether gaussians that were read from a file equal the written ones, up to
    the rounding of logarithms and logits."""
    return len(read) == len(made) and all(
        np.allclose(a, b, rtol=1e-5, atol=1e-6)
        for a, b in (
            (read.means, made.means),
            (read.scales, made.scales),
            (read.opacities, made.opacities),
        )
    )
