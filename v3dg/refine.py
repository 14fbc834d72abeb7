"""Refines all levels of a bundle together, in pictures of cuts, where gaussians hide
each other."""

import os
from collections.abc import Iterable, Mapping

from v3dg import _device
from v3dg._device import Device
from v3dg._numbers import check_type, real, whole
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, check_pinhole
from v3dg.levels.refined import DROP, refined_bundle
from v3dg.opening import File

_UNDISTORT = (
    "undistort the pictures first, or leave it out: distortion='ignore', or --distortion ignore"
)


def refine_bundle(
    bundle: Bundle | File,
    *,
    cameras: Iterable[Camera] | Mapping[str, Camera] = (),
    steps: int = 30_000,
    drop: float = DROP,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
) -> Bundle:
    """Return a copy of a bundle whose levels look more like its asset, in small and
    large pictures.

    A build fits every group alone, seen from all sides, at the size at which it is
    selected. Pictures of cuts show gaussians next to each other, where they hide each
    other. With such pictures, this function drops the least visible gaussians of all
    levels but the first, and moves the others until the pictures match those of the
    asset. Cuts have between 0.7 of the asset's gaussians and the number of the last
    level. Pictures have 0.18 to 9.7 times the native size of the cut, which is 2 px² a
    gaussian. docs/levels.md has the gain.

    The same bundle, cameras, steps, share and seed give the same bits on the same kind
    of device.

    Args:
        bundle: A bundle of `build_bundle`, or its file. The function takes about six
            times the bundle's memory.
        cameras: Views of the asset, also by name: for a room, those of its photographs.
            Views from elsewhere may get worse. Without cameras, pictures are taken from
            all around.
        steps: Number of pictures that are compared. A GPU takes sixteen for each step
            of its gradients, and rounds up.
        drop: Share of a level's visibility, 0 to 0.5, up to which its least visible
            gaussians are dropped; 0 keeps all. Refining a bundle again drops gaussians
            again.
        seed: Seed of the pictures.
        device: The device that computes.
        progress: See `build_bundle`.

    Raises:
        TypeError: ``bundle`` is not a bundle, or a camera is not a camera.
        ValueError: There are no steps, or the share or the seed is out of range.
        RuntimeError: The device is "cuda" and cannot be used.
        KeyboardInterrupt: Ctrl-C was pressed; threads have stopped.
    """
    if isinstance(bundle, str | os.PathLike):
        bundle = Bundle.open(bundle)
    check_type("bundle", bundle, Bundle, "a Bundle")
    if isinstance(cameras, Mapping):
        cameras = cameras.values()
    cameras = list(cameras)
    for number, camera in enumerate(cameras):
        check_type(f"cameras[{number}]", camera, Camera, "a Camera")
        check_pinhole(f"cameras[{number}]", camera, _UNDISTORT)
    steps = whole(steps, "steps", "1 step or more", 1, 1_000_000)
    drop = real(drop, "drop", "a share of 0 to 0.5", 0, 0.5)
    seed = whole(seed, "seed", "0 to 2^58 - 1", 0, (1 << 58) - 1)
    chosen_device = _device.resolve(device)
    return refined_bundle(
        bundle,
        cameras=cameras,
        steps=steps,
        drop=drop,
        seed=seed,
        device=chosen_device,
        progress=progress,
    )
