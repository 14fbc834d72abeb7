"""The renderers that `peers` compares: how each renderer loads a scene, draws a frame,
and runs a training step.

Each renderer is used in the same way as in its authors' example or viewer. Data that do
not depend on the camera, and the tensors of the camera, are prepared before time is
measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import v3dg
from benchmarks.evaluation import gpu
from benchmarks.studies.peers.scenes import Subject
from v3dg.cameras import Camera

Draw: TypeAlias = Callable[[], Any]
"""Draws a frame; the renderer's `picture` converts the result to a picture."""
Prepare: TypeAlias = Callable[[Subject, float], Callable[[Camera], Draw]]
Step: TypeAlias = "Callable[[Raw, Camera, float, Any], Trained]"

INPUTS = ("means", "quats", "scales", "opacities", "sh")
ROWS = ("means", "log_scales", "quats", "logits", "sh")
_FAR = 1e10
_MOST_PAIRS, _MOST_TILES = 1 << 28, 1 << 20
_MOST_SH = 16


@dataclass(frozen=True)
class Raw:
    """Gaussians as optimisers store them: logarithms of scales, logits of opacities."""

    means: Any
    log_scales: Any
    quats: Any
    logits: Any
    sh: Any

    @classmethod
    def of(cls, gaussians: v3dg.Gaussians) -> Raw:
        opacities = gaussians.opacities.double().clamp(1e-6, 1 - 1e-6)
        logits = opacities.logit().to(gaussians.means.dtype)
        return cls(gaussians.means, gaussians.scales.log(), gaussians.quats, logits, gaussians.sh)

    def leaves(self) -> Raw:
        return Raw(*(getattr(self, name).detach().clone().requires_grad_() for name in ROWS))

    def gaussians(self) -> v3dg.Gaussians:
        return v3dg.Gaussians(
            self.means, self.quats, self.log_scales.exp(), self.logits.sigmoid(), self.sh
        )


@dataclass(frozen=True)
class Trained:
    """A prepared training step."""

    forward: Draw
    step: Callable[[], tuple[Any, ...]]
    """Runs a forward and a backward pass; returns gradients."""
    named: Callable[[tuple[Any, ...]], dict[str, Any]]
    """Converts these gradients to a dict with the names of `ROWS`."""


@dataclass(frozen=True)
class Peer:
    """A renderer in one of its modes."""

    name: str
    prepare: Prepare
    picture: Callable[[Any], Any] = lambda frame: frame
    """Converts a drawn frame to a picture (H, W, 3) on black; floats are 0 to 1."""
    train: Step | None = None
    keeps: Callable[[Subject, float], tuple[str, ...]] = lambda subject, filter_px2: INPUTS
    """Names of the subject's arrays that the renderer reads directly; it holds copies
    of the other arrays."""
    sh_degrees: tuple[int, ...] = (0, 1, 2, 3)
    differs: str = ""
    """Differences from gsplat 1.5 that affect errors."""


@dataclass(frozen=True)
class Job:
    """The renderers that one process measures."""

    name: str
    """Name of the job, and of the folder that is put at the front of Python's path."""
    module: str
    """A module that must be importable; without it the job is skipped."""
    peers: tuple[Peer, ...]
    filter_px2: float | None = None
    """The filter variance in px² for which the renderer was compiled; None for any."""


def differentiate(draw: Callable[[Raw, Camera, float], Any]) -> Step:
    """Return the training step of a function that draws a picture (H, W, 3) from
    gaussians."""

    def train(raw: Raw, camera: Camera, filter_px2: float, weights: Any) -> Trained:
        import torch

        leaves = raw.leaves()
        rows = [getattr(leaves, name) for name in ROWS]

        def step() -> tuple[Any, ...]:
            return torch.autograd.grad(draw_it(), rows, weights)

        def draw_it() -> Any:
            return draw(leaves, camera, filter_px2)

        return Trained(draw_it, step, lambda gradients: dict(zip(ROWS, gradients, strict=True)))

    return train


def v3dg_renderer(min_transmittance: float | None) -> Prepare:
    """Return the renderer of v3dg with a transmittance at which pixels stop.

    If `min_transmittance` is None, scenes and bundles use v3dg's default, and assets
    use the value of gsplat.
    """

    def prepare(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
        whole, device = subject.whole(filter_px2), subject.gaussians.means.device.type
        options: dict[str, Any] = {"min_transmittance": min_transmittance}
        if not isinstance(whole, v3dg.Gaussians):
            options["tolerance"] = 0.0
        renderer = v3dg.Renderer(whole, device=device)

        def of(camera: Camera) -> Draw:
            def draw() -> Any:
                frame = renderer.render(camera, **options)
                frame.stats  # noqa: B018  waits for the picture
                return frame

            return draw

        return of

    return prepare


def v3dg_keeps(subject: Subject, filter_px2: float) -> tuple[str, ...]:
    """Return the names of the arrays that are not copied. An asset is drawn directly
    from its arrays; a scene or a bundle is drawn from copies."""
    return INPUTS if subject.layout is None and filter_px2 == 0 else ()


def v3dg_rasterize(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
    return lambda camera: lambda: v3dg.rasterize(subject.gaussians, camera, filter_px2=filter_px2)


def v3dg_training(raw: Raw, camera: Camera, filter_px2: float) -> Any:
    return v3dg.rasterize(raw.gaussians(), camera, filter_px2=filter_px2).color


def gsplat_rasterization(packed: bool) -> Prepare:
    def prepare(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
        def of(camera: Camera) -> Draw:
            return gpu.gsplat_frame(subject.gaussians, camera, packed=packed, eps2d=filter_px2)

        return of

    return prepare


def gsplat_training(packed: bool) -> Step:
    def draw(raw: Raw, camera: Camera, filter_px2: float) -> Any:
        return gpu.gsplat_picture(raw.gaussians(), camera, packed=packed, eps2d=filter_px2)[0]

    return differentiate(draw)


def higs(sh_compression: str) -> Prepare:
    """Return the inference renderer of gsplat's main branch after version 1.5."""

    def prepare(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
        from gsplat.experimental.render import GaussianInferenceRenderer
        from gsplat.scene import GaussianInferenceScene

        g = subject.gaussians
        compression = sh_compression if g.sh_degree == 3 else "none"
        colors, degree = (gpu.base_color(g), None) if g.sh_degree == 0 else (g.sh, g.sh_degree)
        scene = GaussianInferenceScene.from_gaussian_tensors(
            g.means,
            g.quats,
            g.scales,
            g.opacities.clamp(0, 1),
            colors,
            degree,
            compression,
            id="scene",
        )
        renderer = GaussianInferenceRenderer(scene)

        def of(camera: Camera) -> Draw:
            view = {"viewmat": tensor(camera.viewmat, g.means), "K": tensor(camera.K, g.means)}
            view |= {"width": camera.width, "height": camera.height, "near_plane": camera.near}
            return lambda: renderer.render(**view, eps2d=filter_px2)

        return of

    return prepare


def higs_picture(done: Any) -> Any:
    """Return the picture of a frame without its transmittance."""
    return done.frame[0, ..., :3]


def fastergs_inputs(raw: Raw) -> tuple[Any, ...]:
    """Return the inputs in the order of Faster-GS's arguments."""
    rest = raw.sh[:, 1:].contiguous()
    return (
        raw.means,
        raw.log_scales,
        raw.quats,
        raw.logits[:, None],
        raw.sh[:, :1].contiguous(),
        rest,
    )


def fastergs_settings(camera: Camera, like: Any, sh_bases: int) -> Any:
    import torch
    from FasterGSCudaBackend.torch_bindings.rasterization import RasterizerSettings

    return RasterizerSettings(
        tensor(camera.viewmat, like),
        tensor(camera.position, like),
        torch.zeros(3, device=like.device),
        sh_bases,
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        float(camera.K[0, 2]),
        float(camera.K[1, 2]),
        camera.near,
        _FAR,
        False,
    )


def fastergs_inference(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
    from FasterGSCudaBackend.torch_bindings.rasterization import rasterize

    inputs = fastergs_inputs(Raw.of(subject.gaussians))

    def of(camera: Camera) -> Draw:
        settings = fastergs_settings(camera, inputs[0], 1 + inputs[-1].shape[1])
        return lambda: rasterize(*inputs, settings, to_chw=False)

    return of


def fastergs_training(raw: Raw, camera: Camera, filter_px2: float, weights: Any) -> Trained:
    import torch
    from FasterGSCudaBackend.torch_bindings.rasterization import diff_rasterize

    leaves = [t.detach().clone().requires_grad_() for t in fastergs_inputs(raw)]
    settings = fastergs_settings(camera, leaves[0], 1 + leaves[-1].shape[1])
    no_densification = torch.empty(0, device=weights.device)
    planes = weights.permute(2, 0, 1).contiguous()

    def forward() -> Any:
        return diff_rasterize(*leaves, no_densification, settings)

    def named(gradients: tuple[Any, ...]) -> dict[str, Any]:
        means, scales, quats, logits, first, rest = gradients
        values = means, scales, quats, logits[:, 0], torch.cat([first, rest], 1)
        return dict(zip(ROWS, values, strict=True))

    return Trained(forward, lambda: torch.autograd.grad(forward(), leaves, planes), named)


def flashgs(subject: Subject, filter_px2: float) -> Callable[[Camera], Draw]:
    import torch
    from flash_gaussian_splatting import ops

    g = subject.gaussians
    count, device = len(g), g.means.device
    sh = torch.zeros(count, _MOST_SH, 3, device=device)
    sh[:, : g.sh.shape[1]] = g.sh
    inputs = g.means.contiguous(), sh, g.opacities.contiguous(), covariances(g)

    def zeros(*shape: int, dtype: Any) -> Any:
        return torch.zeros(*shape, dtype=dtype, device=device)

    keys, values = ([zeros(_MOST_PAIRS, dtype=t) for _ in "us"] for t in (torch.int64, torch.int32))
    space = zeros(ops.get_sort_buffer_size(_MOST_PAIRS), dtype=torch.int8)
    projected = [zeros(count, size, dtype=torch.float32) for size in (2, 4, 4)]
    num_pairs, black = zeros(1, dtype=torch.int32), torch.zeros(3)

    def of(camera: Camera) -> Draw:
        if (camera.K[0, 2], camera.K[1, 2]) != (camera.width / 2, camera.height / 2):
            raise ValueError(
                "camera: expected the principal point in the middle of the picture, which FlashGS "
                "requires"
            )
        size = camera.width, camera.height, 16, 16
        place = (
            t.float()
            for t in map(torch.as_tensor, (camera.position, camera.viewmat[:3, :3].T.copy()))
        )
        view = *size, *place, camera.fx, camera.fy, _FLASHGS_FAR, camera.near
        ranges = zeros(_MOST_TILES, 2, dtype=torch.int32)

        def draw() -> Any:
            num_pairs.fill_(0)
            ops.preprocess(*inputs, *view, *projected, keys[0], values[0], num_pairs)
            pairs = int(num_pairs.cpu()[0])
            if pairs >= _MOST_PAIRS:
                raise RuntimeError(f"FlashGS: expected fewer than {_MOST_PAIRS} pairs, got {pairs}")
            ops.sort_gaussian(pairs, *size, space, keys[0], values[0], keys[1], values[1])
            color = zeros(camera.height, camera.width, 3, dtype=torch.int8)
            ops.render_16x16(
                pairs,
                camera.width,
                camera.height,
                *projected,
                keys[1],
                values[1],
                ranges,
                black,
                color,
            )
            return color

        return draw

    return of


_FLASHGS_FAR = 100.0  # from FlashGS's example; no scene here is that deep


def flashgs_picture(color: Any) -> Any:
    """Return the picture. FlashGS declares its bytes as signed, so they are
    reinterpreted."""
    import torch

    return color.view(torch.uint8)


def covariances(gaussians: v3dg.Gaussians) -> Any:
    """Return (N, 6) the upper triangles of the covariances in world space."""
    import torch

    w, x, y, z = gaussians.quats.unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    squares = gaussians.scales.square()
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    return torch.stack(
        [sum(rows[i][k] * rows[j][k] * squares[:, k] for k in range(3)) for i, j in upper], 1
    )


def tensor(array: Any, like: Any) -> Any:
    import torch

    return torch.as_tensor(array, dtype=torch.float32, device=like.device).contiguous()


def keeps(*names: str) -> Callable[[Subject, float], tuple[str, ...]]:
    return lambda subject, filter_px2: names


def jobs() -> tuple[Job, ...]:
    """Return the jobs. The first job measures v3dg, and the last one measures it again,
    which shows whether the clock of the GPU has changed."""
    stop = "pixels of scenes and bundles stop behind what leaves a thousandth of the light"
    ours = (
        Peer(
            "v3dg.Renderer", v3dg_renderer(None), lambda f: f.color, keeps=v3dg_keeps, differs=stop
        ),
        Peer("v3dg.Renderer, 1e-4", v3dg_renderer(1e-4), lambda f: f.color, keeps=v3dg_keeps),
        Peer(
            "v3dg.rasterize",
            v3dg_rasterize,
            lambda image: image.color,
            differentiate(v3dg_training),
        ),
    )
    no_clamp = "alpha is not held below 0.999"
    gsplats = tuple(
        Peer(name, gsplat_rasterization(packed), lambda frame: frame[0], gsplat_training(packed))
        for name, packed in (("gsplat packed", True), ("gsplat", False))
    )
    half = "half floats, of the picture too; " + no_clamp + "; pixels do not stop one by one"
    inference = (
        Peer("HiGS", higs("none"), higs_picture, None, keeps(), differs=half),
        Peer(
            "HiGS, 32 bytes",
            higs("32b"),
            higs_picture,
            None,
            keeps(),
            (3,),
            half + "; SH compressed",
        ),
    )
    faster = (
        Peer(
            "Faster-GS",
            fastergs_inference,
            train=fastergs_training,
            keeps=keeps("means", "quats"),
            differs=no_clamp + "; determinants below 1e-6 px⁴ are not drawn",
        ),
    )
    near = "nothing nearer than 0.2; 8 bits, rounded down; 16 SH coefficients always; " + no_clamp
    flash = (
        Peer("FlashGS", flashgs, flashgs_picture, keeps=keeps("means", "opacities"), differs=near),
    )
    return (
        Job("v3dg", "v3dg", ours),
        Job("gsplat", "gsplat", gsplats),
        Job("higs", "gsplat.experimental.render", inference),
        *(
            Job(
                f"fastergs_{px2:g}", "FasterGSCudaBackend.torch_bindings.rasterization", faster, px2
            )
            for px2 in (0.3, 0.0)
        ),
        *(Job(f"flashgs_{px2:g}", "flash_gaussian_splatting", flash, px2) for px2 in (0.3, 0.0)),
        Job("v3dg again", "v3dg", ours[:1]),
    )
