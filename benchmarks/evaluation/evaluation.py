"""The state that the parts of the evaluation share: assets, bundles, and the main scene
with its views and reference pictures."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import worlds
from benchmarks.evaluation.assets import read_layout
from benchmarks.evaluation.measure import Judge, Row, Time, time_ms
from benchmarks.evaluation.settings import Settings
from benchmarks.worlds.procedural import make_asset
from v3dg import _device
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.cleaning import ball_of_most
from v3dg.gaussians import Gaussians
from v3dg.image import Stats
from v3dg.io import read_asset
from v3dg.levels import BuildConfig, build_bundle
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, to_8bit
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

FOV_X = math.pi / 4  # horizontal field of view in the paper, in radians
_MOST_PICTURE_PX = 1400, 2000
PAPER_CLUSTER_SIZE = BuildConfig.paper().cluster_size


def paper_tolerance(tau_px2: float) -> float:
    """Convert a tolerance of the paper to a tolerance of v3dg.

    The paper measures a group that is drawn as one cluster in px². v3dg measures px²
    per gaussian.
    """
    return tau_px2 / PAPER_CLUSTER_SIZE


PAPER_TOLERANCE = paper_tolerance(2048)


@dataclass(frozen=True)
class View:
    """A camera that looks at the origin, and its position: azimuth and elevation in
    degrees, and distance in world units."""

    azimuth: float
    elevation: float
    distance: float
    camera: Camera

    def row(self) -> Row:
        return {
            "azimuth": round(self.azimuth, 1),
            "elevation": round(self.elevation, 1),
            "distance": round(self.distance, 4),
        }


def views_of(cameras: Iterable[Camera]) -> list[View]:
    views = []
    for camera in cameras:
        x, y, z = camera.position
        distance = math.sqrt(x * x + y * y + z * z)
        azimuth, elevation = math.degrees(math.atan2(y, x)), math.degrees(math.asin(z / distance))
        # Angles in files are rounded. A value just below 0 must not become a separate
        # direction at 360 degrees.
        views.append(View(round(azimuth, 2) % 360, elevation, distance, camera))
    return views


def orbit_view(azimuth: float, elevation: float, distance: float, size: tuple[int, int]) -> View:
    """Return a camera that looks at the origin; angles in degrees, distance in world
    units."""
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = distance * np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    camera = Camera.look_at(
        eye, (0, 0, 0), fov_x=FOV_X, width=size[0], height=size[1], near=1e-3 * distance
    )
    return View(azimuth, elevation, distance, camera)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the same camera with another picture size, (width, height) in px."""
    factors = np.array([[size[0] / camera.width], [size[1] / camera.height], [1.0]])
    return replace(camera, K=camera.K * factors, width=size[0], height=size[1])


def close_distance(asset: Gaussians) -> tuple[Any, float]:
    """Return the centre of an asset without its outliers, (3,), and the distance at
    which the asset fills a square picture."""
    center, radius = ball_of_most(_device.to_host(asset.means))
    return center, radius / math.tan(FOV_X / 2)


def close_view(asset: Gaussians, size: tuple[int, int]) -> Camera:
    """Return a camera in front of the asset and above it, at the distance where the
    asset fills the picture."""
    center, distance = close_distance(asset)
    eye = center + distance * np.array([0.0, -0.8, 0.6])
    return Camera.look_at(
        eye, center, fov_x=FOV_X, width=size[0], height=size[1], near=1e-3 * distance
    )


@dataclass(frozen=True)
class Built:
    bundle: Bundle
    seconds: float


@dataclass(frozen=True)
class Shot:
    """The measurement of one view: picture, statistics and time. The picture is drawn
    before and after the timed runs, and both must have the same bytes."""

    view: View
    picture: Picture
    stats: Stats
    time: Time

    def row(self, name: str) -> Row:
        return {
            f"{name}_selected": self.stats.gaussians_selected,
            f"{name}_in_frustum": self.stats.gaussians_in_frustum,
            f"{name}_select_ms": round(self.stats.select_ms, 3),
            **self.time.row(name),
        }


@dataclass
class Evaluation:
    """The settings of one evaluation."""

    settings: Settings
    device: str
    folder: Path
    seed: int = 0
    scenes: tuple[str, ...] = ()
    """Names of the composed scenes to draw; all if empty."""
    asset_path: Path | None = None
    layout_path: Path | None = None
    peers: Path | None = None
    """Folder with levels of the asset made by other tools: <asset>_<tool>_<percent>.ply
    and seconds.json (see parts/merging.py)."""
    pictures: list[str] = field(default_factory=list)
    """Names of the files that the current part has saved."""
    judge: Judge = field(default_factory=Judge)
    _built: dict[str, Built] = field(default_factory=dict)
    _truths: dict[int, Picture] = field(default_factory=dict)

    @cached_property
    def asset(self) -> Gaussians:
        if self.asset_path is None:
            return self._main_world.assets["donut"].make()
        return read_asset(self.asset_path)

    @property
    def asset_name(self) -> str:
        return "made_donut" if self.asset_path is None else self.asset_path.stem

    def warm_up(self) -> None:
        """Load everything that the first build and the first picture need, so that no
        measured time includes it."""
        tiny = make_asset(1000)
        bundle = build_bundle(
            tiny, config=BuildConfig(steps=2), progress=False, device=self._device, quality="draft"
        )
        render(bundle, orbit_view(0, 45, 5, (64, 64)).camera, device=self.device).stats  # noqa: B018

    @property
    def _device(self) -> Any:
        return self.device

    def build(self, config: BuildConfig | None = None, asset: Gaussians | None = None) -> Built:
        """Build an asset, by default the main one. Bundles of the main asset are
        cached."""
        config = config or BuildConfig()
        key = json.dumps(asdict(config))
        if asset is None and key in self._built:
            return self._built[key]
        start = time.perf_counter()
        bundle = build_bundle(
            self.asset if asset is None else asset,
            config=config,
            seed=self.seed,
            progress=False,
            device=self._device,
            quality="draft",
        )
        built = Built(bundle, time.perf_counter() - start)
        if asset is None:
            self._built[key] = built
        return built

    def place(self, bundle: Bundle, instances: int | None = None) -> Scene:
        """Return the main scene with this bundle; `instances` limits it to its first
        instances."""
        scene = Scene()
        positions, quaternions, scales = self._layout[0]
        few = slice(instances)
        scene.add(
            bundle, positions=positions[few], quaternions=quaternions[few], scales=scales[few]
        )
        return scene

    @cached_property
    def _main_world(self) -> worlds.World:
        settings = self.settings
        return worlds.donut_sea(settings.instances, settings.asset_gaussians, seed=self.seed)

    @cached_property
    def _layout(self) -> tuple[tuple[Any, Any, Any], list[View]]:
        size = self.settings.size
        if self.layout_path is None:
            world = self._main_world
            placement = world.placements["donut"]
            views = views_of(world.cameras(width=size[0], height=size[1]).values())
            return (placement.positions, placement.quaternions, placement.scales), views
        scene, cameras = read_layout(self.layout_path, self.build(BuildConfig(steps=0)).bundle)
        views = views_of(resized(camera, size) for camera in cameras.values())
        return (scene.positions, scene.quaternions, scene.scales), views

    @cached_property
    def full_scene(self) -> Scene:
        """Return the main scene with the bundle of the default settings."""
        return self.place(self.build().bundle)

    @cached_property
    def all_views(self) -> list[View]:
        """Return the views of the main scene that the settings request."""
        return self._some_of(self._layout[1])

    def _some_of(self, views: Sequence[View]) -> list[View]:
        """Return the views, of the paper's 400, that have the directions, elevations
        and distances of the settings."""
        azimuths = sorted({round(v.azimuth) for v in views})[: self.settings.directions]
        lines: dict[tuple[int, int], list[View]] = {}
        for view in views:
            if (
                round(view.azimuth) in azimuths
                and min(abs(view.elevation - e) for e in self.settings.elevations) < 0.5
            ):
                lines.setdefault((round(view.azimuth), round(view.elevation)), []).append(view)
        return [view for line in lines.values() for view in every(line, self.settings.distances)]

    @cached_property
    def camera_sweep(self) -> list[View]:
        """Return the views of one direction and the middle elevation, from near to
        far."""
        middle = sorted(self.settings.elevations)[len(self.settings.elevations) // 2]
        first = self.all_views[0].azimuth
        line = [
            v
            for v in self.all_views
            if abs(v.azimuth - first) < 0.5 and abs(v.elevation - middle) < 0.5
        ]
        return every(line, self.settings.sweep_distances)

    def truth(self, index: int) -> Picture:
        """Return the reference picture of a view of the camera sweep, which is
        supersampled and shows all gaussians."""
        if index not in self._truths:
            self._truths[index] = draw_truth(
                self.full_scene, self.camera_sweep[index].camera, self.device
            )
        return self._truths[index]

    def shoot(
        self,
        subject: Any,
        view: View,
        tolerance: float = DEFAULT_TOLERANCE,
        repeats: int | None = None,
    ) -> Shot:
        """Draw a view, time it, and draw it again.

        Raises:
            RuntimeError: The picture is black, or the two pictures differ.
        """

        def draw() -> Any:
            return render(subject, view.camera, tolerance=tolerance, device=self.device)

        picture = to_8bit(draw().color)
        if not picture.any():
            raise RuntimeError(
                f"picture at distance {view.distance:g}: expected a visible scene, got a black "
                "picture"
            )
        timed = time_ms(lambda: draw().stats, self.device, repeats or self.settings.repeats)
        last = draw()
        if not np.array_equal(picture, to_8bit(last.color)):
            raise RuntimeError(
                f"picture at distance {view.distance:g}: expected the same bytes in every run, got "
                "different ones"
            )
        return Shot(view, picture, last.stats, timed)

    def shoot_sweep(self, scene: Scene, tolerance: float = DEFAULT_TOLERANCE) -> list[Shot]:
        return [self.shoot(scene, view, tolerance) for view in self.camera_sweep]

    @cached_property
    def full_sweep(self) -> list[Shot]:
        """Return the camera sweep with all gaussians at one sample per pixel, the
        baseline for levels of detail."""
        return self.shoot_sweep(self.full_scene, 0.0)

    def judge_sweep(self, shots: Sequence[Shot]) -> list[Row]:
        """Return FLIP and PSNR of pictures of the camera sweep, in the order of its
        views."""
        return self.judge.errors((self.truth(i), shot.picture) for i, shot in enumerate(shots))

    def sweep_rows(self, shots: Sequence[Shot], name: str) -> list[Row]:
        """Return a row per view: its position, and the statistics, time and error of
        its picture."""
        errors = self.judge_sweep(shots)
        return [
            {
                **shot.view.row(),
                **shot.row(name),
                **{f"{name}_{key}": value for key, value in error.items()},
            }
            for shot, error in zip(shots, errors, strict=True)
        ]

    def composed_scenes(self) -> Iterator[tuple[str, Scene, list[View]]]:
        """Yield the name, scene and views of each composed scene."""
        name = self._main_world.name if self.layout_path is None else self.layout_path.stem
        if not self.scenes or name in self.scenes:
            yield name, self.full_scene, self.all_views
        width, height = self.settings.size
        for world in self._other_worlds:
            if self.scenes and world.name not in self.scenes:
                continue
            bundles = {name: self._world_bundle(world, name) for name in world.assets}
            views = views_of(world.cameras(width=width, height=height).values())
            yield world.name, worlds.scene_of(world, bundles), self._some_of(views)

    @cached_property
    def _other_worlds(self) -> list[worlds.World]:
        return [
            getattr(worlds, name)(instances, gaussians, seed=self.seed)
            for name, (instances, gaussians) in self.settings.worlds.items()
        ]

    def _world_bundle(self, world: worlds.World, name: str) -> Bundle:
        if name not in self._built:
            config = BuildConfig(steps=self.settings.world_steps)
            self._built[name] = self.build(config, world.assets[name].make())
        return self._built[name].bundle

    def close_bundles(self) -> Iterator[tuple[str, Bundle]]:
        """Yield assets for close views: the main one, and the first of each world."""
        yield self.asset_name, self.build().bundle
        for world in self._other_worlds:
            name = next(iter(world.assets))
            yield name, self._world_bundle(world, name)

    def save(self, name: str, picture: Picture) -> None:
        """Save a picture as a JPEG that is small enough for a repository."""
        from PIL import Image

        image = Image.fromarray(picture)
        image.thumbnail(_MOST_PICTURE_PX)
        image.save(self.folder / f"{name}.jpg", quality=80)
        self.pictures.append(f"{name}.jpg")


def every(items: Sequence[Any], count: int) -> list[Any]:
    """Return `count` of the items, evenly spaced and including the last; all items if
    there are no more."""
    if count >= len(items):
        return list(items)
    return [items[round((i + 1) * len(items) / count) - 1] for i in range(count)]
