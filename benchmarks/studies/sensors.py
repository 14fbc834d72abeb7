"""What do many small pictures cost beside those of other renderers, and how far is each
from the supersampled picture?

`make` builds different assets into a folder. `measure` stands them on a floor and draws
the same cameras at eye level with a batch of v3dg, with gsplat 1.5 and, if they can be
imported, with the vectorized renderer for Isaac Sim and the ray-traced sensor of
Newton. The others get all gaussians in world space. The study needs a GPU.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.evaluation import resized
from benchmarks.evaluation.measure import Judge, times_ms
from benchmarks.ops import bench_sensors
from benchmarks.worlds import procedural
from v3dg import metrics
from v3dg.pictures import Picture, to_8bit

if TYPE_CHECKING:
    import newton
    import torch
    import warp

Row: TypeAlias = dict[str, object]

_SIDE = 2.4  # longest side of an object in units
_AISLE = 0.25  # half the width of the aisles between objects in units
_SAMPLES = 8  # of a reference picture along each side of a pixel of the largest size
_FEW = 4  # judged cameras that are drawn together
_PEER_REPEATS = 3  # timed calls of other renderers
_TRANSMITTANCES = (0.49, 0.01)  # of Newton: its default, and one for semitransparent pixels
_SCENE_ID = 0  # the name of the only scene of the vectorized renderer


@dataclass
class Make:
    """Build the assets that are not in the folder yet."""

    folder: Path
    gaussians: int = 125_000
    """Gaussians of an asset."""
    quality: Literal["draft", "standard"] = "draft"
    device: str = "cuda"


@dataclass
class Measure:
    """Draw and compare."""

    folder: Path
    objects: int = 16
    cameras: int = 256
    judged: int = 32
    """Cameras whose pictures are compared with supersampled ones."""
    sizes: tuple[int, ...] = (64, 128, 256)
    tolerances: tuple[float, ...] = (0.0, 1.0, 3.0, 6.0, 12.0, 24.0, 48.0)
    batches: tuple[int, ...] = (64, 16, 4)
    """Cameras that the other renderers draw in one call; the fastest counts."""
    timed: int = 64
    """Cameras of which the others' rate is measured."""
    repeats: int = 7
    device: str = "cuda"
    output: Path | None = None


def main(config: Make | Measure) -> None:
    if isinstance(config, Make):
        make(config)
        return
    scene = floor_of(config)
    cameras = cameras_of(scene, config.cameras, max(config.sizes))
    result: Row = {
        "objects": len(scene),
        "assets": sorted(path.stem for path in config.folder.glob("*.v3dg")),
        "cameras": config.cameras,
        "judged": config.judged,
        "sh_degree": 0,
    }
    rows: list[Row] = []
    result["rows"] = rows
    for row in Comparison(config, scene, cameras).rows():
        rows.append(row)
        print(json.dumps(row), flush=True)
        record.write(config.output, result, config.device)


def make(config: Make) -> None:
    config.folder.mkdir(parents=True, exist_ok=True)
    for name, asset in assets_of(config.gaussians):
        if (config.folder / f"{name}.v3dg").exists():
            continue
        bundle = v3dg.build_bundle(
            flat(asset), quality=config.quality, progress=False, device=config.device
        )
        bundle.write(config.folder / f"{name}.v3dg")
        print(name, len(asset), flush=True)


def assets_of(count: int) -> Iterator[tuple[str, v3dg.Gaussians]]:
    """Yield 16 assets of five kinds with their names."""
    for seed in range(4):
        yield f"toadstools_{seed}", procedural.make_asset(count, seed=seed)
        yield f"person_{seed}", procedural.make_person(count, seed=seed)
    for kind in ("oak", "birch", "cherry", "spruce"):
        yield f"tree_{kind}", procedural.make_tree(count, kind=kind)
    for seed in range(2):
        yield f"temple_{seed}", procedural.make_temple(count, seed=seed)
        yield f"donut_{seed}", procedural.make_donut(count, seed=seed)


def flat(asset: v3dg.Gaussians) -> v3dg.Gaussians:
    """Return an asset whose colours do not depend on the view, which is what the
    vectorized renderer can draw."""
    return v3dg.Gaussians(
        asset.means,
        asset.quats,
        asset.scales,
        asset.opacities,
        np.ascontiguousarray(asset.sh[:, :1]),
    )


def floor_of(config: Measure) -> v3dg.Scene:
    """Return objects of one size that stand on a floor."""
    bundles = [v3dg.Bundle.open(path) for path in sorted(config.folder.glob("*.v3dg"))]
    scene = bench_sensors.floor_of(bundles, config.objects)
    lows = []
    scales = []
    for bundle in bundles:
        means = bundle.level_gaussians(0).means
        low = means.min(axis=0)
        scale = _SIDE / float((means.max(axis=0) - low).max())
        lows.append(-scale * float(low[2]))
        scales.append(scale)
    turns = np.arange(config.objects) % len(bundles)
    positions = np.array(scene.positions)
    positions[:, 2] = np.asarray(lows)[turns]
    scene.move(positions=positions, scales=np.asarray(scales)[turns])
    return scene


def cameras_of(scene: v3dg.Scene, count: int, side: int) -> list[v3dg.Camera]:
    """Return cameras at eye level in the aisles between the objects. Each camera looks
    at one object."""
    rng = np.random.default_rng(1)
    lines = np.unique(scene.positions[:, 0])
    margin = bench_sensors.PITCH / 2
    crossings = np.append(lines - margin, lines[-1] + margin)
    height = bench_sensors.EYE
    cameras = []
    for _ in range(count):
        eye = np.append(rng.choice(crossings, 2) + rng.uniform(-_AISLE, _AISLE, 2), height)
        target = scene.positions[rng.integers(len(scene))] + [0, 0, height / 2]
        cameras.append(v3dg.Camera.look_at(eye, target, fov_x=1.2, width=side, height=side))
    return cameras


class Peer(Protocol):
    """A renderer that draws all gaussians of a scene for a batch of cameras."""

    @property
    def name(self) -> str: ...

    def draw(self, viewmats: torch.Tensor, K: torch.Tensor, size: int) -> torch.Tensor:
        """Return pictures (B, H, W, 3) on black."""
        ...


@dataclass(frozen=True)
class Gsplat:
    """gsplat 1.5 in one of its modes."""

    gaussians: v3dg.Gaussians
    packed: bool
    eps2d: float = 0.0
    antialiased: bool = False

    @property
    def name(self) -> str:
        words = ["gsplat"]
        if self.packed:
            words.append("packed")
        if self.antialiased:
            words.append("antialiased")
        return " ".join(words)

    def draw(self, viewmats: torch.Tensor, K: torch.Tensor, size: int) -> torch.Tensor:
        import gsplat

        g = self.gaussians
        mode: Literal["classic", "antialiased"] = "classic"
        if self.antialiased:
            mode = "antialiased"
        pictures: torch.Tensor
        pictures, _, _ = gsplat.rasterization(
            g.means,
            g.quats,
            g.scales,
            g.opacities,
            gpu.base_color(g),
            viewmats,
            K,
            size,
            size,
            near_plane=0.01,
            eps2d=self.eps2d,
            packed=self.packed,
            rasterize_mode=mode,
        )
        return pictures


@dataclass
class Vectorized:
    """The vectorized renderer for Isaac Sim: only colours, and no filter."""

    gaussians: v3dg.Gaussians
    name: str = "vectorized"
    _services: dict[tuple[int, int], object] = field(default_factory=dict)

    def draw(self, viewmats: torch.Tensor, K: torch.Tensor, size: int) -> torch.Tensor:
        import torch

        service = self._service(len(viewmats), size)
        scene_ids = torch.full((len(viewmats),), _SCENE_ID, device=viewmats.device)
        outputs = service.render(viewmats, K, scene_ids)  # type: ignore[attr-defined]
        pictures: torch.Tensor = outputs["rgb"]
        return pictures

    def _service(self, count: int, size: int) -> object:
        import torch

        if (count, size) not in self._services:
            self._services.clear()
            module = importlib.import_module("isaacsim_gaussian_renderer")
            backend = module.CustomCudaBackend(covariance_epsilon=0.0, output_srgb=False)
            service = module.RendererService(
                backend, height=size, width=size, outputs=("rgb",), max_views=count
            )
            service.initialize(None, "cuda")
            g = self.gaussians
            service.load_scene(
                _SCENE_ID,
                means=g.means,
                scales=g.scales,
                rotations=g.quats,
                opacities=g.opacities,
                features=gpu.base_color(g).contiguous(),
                semantic_ids=torch.zeros(len(g), dtype=torch.int64, device="cuda"),
            )
            self._services[count, size] = service
        return self._services[count, size]


@dataclass
class NewtonSensor:
    """`newton.sensors.SensorCamera`, which traces a ray for each pixel.

    A pixel that more light passes than `transmittance` is left empty, so small values
    are needed for rays to gather what is semitransparent.
    """

    gaussians: v3dg.Gaussians
    transmittance: float
    device: str = "cuda"
    _loaded: tuple[newton.Model, newton.sensors.SensorCamera] | None = None
    _poses: dict[tuple[int, ...], warp.array] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return f"newton {self.transmittance:g}"

    def draw(self, viewmats: torch.Tensor, K: torch.Tensor, size: int) -> torch.Tensor:
        import newton
        import torch
        import warp

        if self._loaded is None:
            model = self._make_model()
            self._loaded = (model, newton.sensors.SensorCamera(model))
        model, sensor = self._loaded
        count = len(viewmats)
        focal_length = float(K[0, 1, 1])
        rays = sensor.compute_camera_rays_pinhole(
            size, size, camera_fov=2 * math.atan(size / (2 * focal_length)), device=self.device
        )
        picture = sensor.allocate_image_color(count, size, size)
        sensor.update(
            model.state(),
            self._transforms(viewmats),
            rays,
            color_image=picture,
            world_indices=warp.zeros(count, dtype=warp.int32, device=self.device),
            render_config=sensor.RenderConfig(
                gaussians_mode=sensor.GaussianRenderMode.QUALITY,
                gaussians_min_transmittance=self.transmittance,
            ),
        )
        packed = warp.to_torch(picture.view(warp.int32))
        channels = [(packed >> shift) & 0xFF for shift in (0, 8, 16)]
        return torch.stack(channels, dim=-1) / 255

    def _make_model(self) -> newton.Model:
        """Return a model with one world, in which all gaussians are one shape."""
        import newton

        g = self.gaussians
        builder = newton.ModelBuilder()
        builder.begin_world()
        builder.add_shape_gaussian(
            -1,
            gaussian=newton.Gaussian(
                to_numpy(g.means),
                np.roll(to_numpy(g.quats), -1, axis=1),
                to_numpy(g.scales),
                to_numpy(g.opacities),
                to_numpy(g.sh)[:, 0],
            ),
        )
        builder.end_world()
        return builder.finalize(device=self.device)

    def _transforms(self, viewmats: torch.Tensor) -> warp.array:
        """Return poses from camera to world, whose cameras look along -z. They are
        computed once, because the time of a draw does not include them."""
        import warp

        key = (viewmats.data_ptr(), *viewmats.shape)
        if key not in self._poses:
            to_world = np.linalg.inv(to_numpy(viewmats).astype(np.float64))
            to_world[:, :, 1:3] *= -1
            poses = []
            for matrix in to_world:
                turn = warp.quat_from_matrix(warp.mat33(*matrix[:3, :3].ravel()))
                poses.append([*matrix[:3, 3], *turn])
            self._poses[key] = warp.array(poses, dtype=warp.transformf, device=self.device)
        return self._poses[key]


class Comparison:
    """A scene's reference pictures, and the measurements of each renderer."""

    def __init__(self, config: Measure, scene: v3dg.Scene, cameras: list[v3dg.Camera]) -> None:
        self.config = config
        self.cameras = cameras
        self.renderer = v3dg.Renderer(scene, device=config.device, memory=None)
        self.renderer_of_all = v3dg.Renderer(scene, device=config.device, memory=None)
        self.judge = Judge()
        self.fine = self._fine_pictures()
        print(f"{len(self.fine)} reference pictures", flush=True)
        self.world = v3dg.select(
            scene, cameras[0], tolerance=0.0, cull=False, device=config.device
        ).gaussians(device=config.device)

    def rows(self) -> Iterator[Row]:
        """Yield a row for each size and renderer."""
        for size in self.config.sizes:
            for row in self._rows_of(size):
                yield {"size": size, **row}
        self.judge.close()

    def _fine_pictures(self) -> list[Picture]:
        """Draw all gaussians for the judged cameras, with several samples along each
        side of a pixel of the largest size."""
        return [
            np.asarray(metrics.box_downsample(self._fine(camera), _SAMPLES), dtype=np.float32)
            for camera in self.cameras[: self.config.judged]
        ]

    def _fine(self, camera: v3dg.Camera) -> Picture:
        image = self.renderer_of_all.render(
            camera.scaled(_SAMPLES), tolerance=0.0, min_transmittance=metrics.MIN_TRANSMITTANCE
        )
        color: Picture = to_numpy(image.color.clip(0, 1))
        return color

    def _truths(self, size: int) -> list[Picture]:
        factor = max(self.config.sizes) // size
        return [to_8bit(metrics.box_downsample(picture, factor)) for picture in self.fine]

    def _rows_of(self, size: int) -> Iterator[Row]:
        truths = self._truths(size)
        ours = {
            tolerance: self._ours(size, tolerance, truths) for tolerance in self.config.tolerances
        }
        yield from ours.values()
        fastest_rows = []
        for peers in self._peers():
            rows = [row for peer in peers for row in self._peer_rows(peer, size, truths)]
            if rows:
                fastest_rows.append(max(rows, key=lambda row: number(row["rate"])))
            yield from rows
        for fastest in fastest_rows:
            tolerance = tolerance_of_equal_error(ours, number(fastest["flip"]))
            row = self._ours(size, tolerance, truths)
            yield {"at_error_of": fastest["renderer"], **row}

    def _peers(self) -> list[list[Peer]]:
        """Return the modes of each other renderer that can be imported. The modes of
        one have the same pictures."""
        peers: list[list[Peer]] = []
        if self.config.device == "cpu":
            return peers
        if gpu.has_gsplat():
            peers.append([Gsplat(self.world, packed) for packed in (False, True)])
            filtered = Gsplat(self.world, packed=True, eps2d=0.3, antialiased=True)
            peers.append([filtered])
        if importlib.util.find_spec("isaacsim_gaussian_renderer") is not None:
            peers.append([Vectorized(self.world)])
        if importlib.util.find_spec("newton") is not None:
            peers.append([NewtonSensor(self.world, bound) for bound in _TRANSMITTANCES])
        return peers

    def _cameras_of(self, size: int) -> list[v3dg.Camera]:
        return [resized(camera, (size, size)) for camera in self.cameras]

    def _ours(self, size: int, tolerance: float, truths: list[Picture]) -> Row:
        cameras = self._cameras_of(size)
        judged = cameras[: len(truths)]
        renderer = self.renderer
        if tolerance == 0:
            # All gaussians, for as many cameras as the others are timed with. Batches
            # that do not fit make the parts of a renderer smaller for good.
            cameras = cameras[: self.config.timed]
            renderer = self.renderer_of_all
        batch = bench_sensors.batch_on(cameras, self.config.device)
        drawn = [
            renderer.render_batch(
                bench_sensors.batch_on(judged[first : first + _FEW], self.config.device),
                tolerance=tolerance,
            )
            for first in range(0, len(judged), _FEW)
        ]
        pictures = np.concatenate([to_numpy(part.color) for part in drawn])
        gaussians = np.concatenate([part.stats.gaussians_in_frustum for part in drawn]).mean()
        renderer.render_batch(batch, tolerance=tolerance).wait()
        rate = bench_sensors.rate(
            lambda: renderer.render_batch(batch, tolerance=tolerance),
            len(cameras),
            self.config,
        )
        return {
            "renderer": "v3dg",
            "tolerance": round(tolerance, 3),
            "rate": rate,
            "gaussians": round(float(gaussians)),
            **self._errors(truths, pictures),
        }

    def _peer_rows(self, peer: Peer, size: int, truths: list[Picture]) -> Iterator[Row]:
        """Yield a row for each number of cameras in a call that fits into memory."""
        import torch

        cameras = self._cameras_of(size)
        batch = v3dg.CameraBatch.of(cameras)
        viewmats = torch.tensor(batch.viewmats, dtype=torch.float32, device=self.config.device)
        K = torch.tensor(batch.K, dtype=torch.float32, device=self.config.device)
        for count in self.config.batches:
            torch.cuda.empty_cache()

            def draw(first: int, count: int = count) -> torch.Tensor:
                last = first + count
                return peer.draw(viewmats[first:last], K[first:last], size)

            try:
                with torch.no_grad():
                    yield self._peer_row(peer, draw, count, truths)
            except (RuntimeError, ValueError) as error:
                text = " ".join(str(error).split())[:200]
                print(f"{peer.name}, {count} cameras of {size} px: {text}", flush=True)

    def _peer_row(
        self, peer: Peer, draw: Callable[[int], torch.Tensor], count: int, truths: list[Picture]
    ) -> Row:
        starts = range(0, self.config.timed, count)
        pictures = [draw(first).cpu().numpy() for first in range(0, len(truths), count)]

        def draw_all() -> None:
            for first in starts:
                draw(first)

        draw_all()
        ms = statistics.median(times_ms(draw_all, self.config.device, _PEER_REPEATS))
        errors = self._errors(truths, np.concatenate(pictures)[: len(truths)])
        return {
            "renderer": peer.name,
            "cameras_in_a_call": count,
            "rate": round(1e3 * self.config.timed / ms, 1),
            **errors,
        }

    def _errors(self, truths: list[Picture], pictures: Picture) -> Row:
        """Return the mean of FLIP and PSNR of 8-bit pictures, and the root of the mean
        square error over all of them."""
        pairs = [(truth, to_8bit(picture)) for truth, picture in zip(truths, pictures, strict=True)]
        rows = self.judge.errors(pairs)
        squares = [np.square((a.astype(np.float64) - b) / 255).mean() for a, b in pairs]
        psnrs = [row["psnr"] for row in rows if row["psnr"] is not None]
        return {
            "flip": round(statistics.fmean(row["flip"] for row in rows), 5),
            "psnr": round(statistics.fmean(psnrs), 2),
            "rmse": round(math.sqrt(statistics.fmean(squares)), 6),
        }


def number(value: object) -> float:
    assert isinstance(value, float)
    return value


def to_numpy(array: v3dg.gaussians.Array) -> Picture:
    if isinstance(array, np.ndarray):
        return array
    picture: Picture = array.cpu().numpy()
    return picture


def tolerance_of_equal_error(rows: dict[float, Row], flip: float) -> float:
    """Return the largest tolerance at which the error is at most `flip`, interpolated
    between measured tolerances; 0 if all errors are larger."""
    tolerances = sorted(rows)
    errors = [number(rows[tolerance]["flip"]) for tolerance in tolerances]
    for index in reversed(range(len(tolerances))):
        if errors[index] > flip:
            continue
        if index + 1 == len(tolerances):
            return tolerances[index]
        share = (flip - errors[index]) / (errors[index + 1] - errors[index])
        return tolerances[index] + share * (tolerances[index + 1] - tolerances[index])
    return 0.0


if __name__ == "__main__":
    main(tyro.cli(Make | Measure))
