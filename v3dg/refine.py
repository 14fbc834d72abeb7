"""Refines all levels of a bundle together, by comparing pictures of cuts with pictures
of the asset."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import get_args

from v3dg._device import Device
from v3dg._numbers import check_type, one_of, real, refuse, whole
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, check_pinhole
from v3dg.levels.refined import DROP, RefineRequest
from v3dg.levels.refined_units import refined_bundle
from v3dg.levels.unfinished import discard_units, locked_units, units_folder
from v3dg.levels.viewpoints import SeenFrom
from v3dg.levels.whole import devices_for
from v3dg.opening import File

_UNDISTORT = (
    "undistort the pictures first, or ignore the distortion: distortion='ignore' in Python, "
    "--distortion ignore in a command"
)


def refine_bundle(
    bundle: Bundle | File,
    *,
    cameras: Iterable[Camera] | Mapping[str, Camera] = (),
    seen_from: SeenFrom = "auto",
    steps: int = 30_000,
    drop: float = DROP,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
    folder: str | os.PathLike[str] | None = None,
) -> Bundle:
    """Return a copy of a bundle whose levels look more like its asset.

    A build fits every group alone, seen from all directions, at the size at which it is
    selected. In pictures of whole cuts, however, gaussians of different groups hide
    each other. This function compares pictures of cuts with pictures of the asset. It
    drops the least visible gaussians of each level above level 0, and optimises the
    others until the pictures match. The number of gaussians in a cut ranges from that
    of the last level to 0.7 times that of the asset. The size of a picture ranges from
    0.18 to 9.7 times the native size of its cut, which is 2 px² per gaussian.
    docs/levels.md describes the gain.

    The same bundle, cameras, steps, share and seed give the same bits on the same kind
    of device.

    Args:
        bundle: A bundle of `build_bundle`, or the path of its file. The function needs
            about six times the memory of the bundle. A bundle of an asset with more
            than 4,194,304 gaussians, or 2,097,152 of SH degree 3, is refined in units
            of at most that size, and needs the memory of a unit; see `folder`.
        cameras: Cameras of the pictures, in a sequence or by name, such as those of the
            asset's photographs. Views from other positions may get worse.
        seen_from: Where pictures are taken from if there are no cameras. "outside"
            means from all directions. "inside" means from up to 96 eyes in the free
            space that the asset surrounds. "both" takes half of the pictures from each.
            "auto" detects which of them applies. It is "inside" if the asset surrounds
            a free place with something in it, as a room does. It is "both" if that
            place is open above, as a street is, or if more than the walls is seen from
            outside. In other cases, it is "outside". The config of the result records
            the choice.
        steps: Number of pictures that are compared, for each unit. A GPU uses sixteen
            of them for each optimisation step, so the number is rounded up.
        drop: Fraction of a level's visibility, 0 to 0.5, that may be lost by dropping
            its least visible gaussians. 0 keeps all gaussians. Each further refinement
            of a bundle drops gaussians again. An asset that is mostly of opacities
            below 0.1, such as smoke, keeps all gaussians, because it hides none.
        seed: Seed of the pictures.
        device: The device that computes.
        progress: See `build_bundle`.
        folder: Where finished units of a large bundle are stored. If the folder has
            units of an interrupted call with the same arguments, they are not refined
            again. The result reads its gaussians from the folder and from the file of
            the bundle, so the bundle must be in a file. By default, units and the
            result are in memory.

    Raises:
        TypeError: ``bundle`` is not a Bundle, or an element of ``cameras`` is not a
            Camera.
        ValueError: ``steps``, ``drop`` or ``seed`` is out of range, or ``seen_from`` is
            "inside" or "both" and the asset surrounds no place.
        RuntimeError: The device is "cuda" and cannot be used, or another refinement is
            using the folder.
        KeyboardInterrupt: Ctrl-C was pressed; threads have stopped, and finished units
            are in the folder.
    """
    bundle, request = _checked(bundle, cameras, seen_from, steps, drop, seed)
    devices = devices_for(device)
    if folder is None:
        return refined_bundle(bundle, request, devices, progress)
    with locked_units(Path(folder)) as units:
        return refined_bundle(bundle, request, devices, progress, units)


def refine_file(
    bundle: Bundle | File,
    output: Path,
    *,
    cameras: Iterable[Camera] | Mapping[str, Camera] = (),
    seen_from: SeenFrom = "auto",
    steps: int = 30_000,
    drop: float = DROP,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
) -> Bundle:
    """Write what `refine_bundle` returns to a file, and return it, opened from there.

    Finished units of a large bundle are beside the file until it is written, so another
    call with the same arguments continues after the last one.

    Raises:
        RuntimeError: Another refinement is writing this file, or the device is "cuda"
            and cannot be used.
        Exception: See `refine_bundle`.
    """
    bundle, request = _checked(bundle, cameras, seen_from, steps, drop, seed)
    with locked_units(units_folder(output)) as units:
        refined_bundle(bundle, request, devices_for(device), progress, units).write(output)
        discard_units(output)
    return Bundle.open(output)


def _checked(
    bundle: Bundle | File,
    cameras: Iterable[Camera] | Mapping[str, Camera],
    seen_from: SeenFrom,
    steps: int,
    drop: float,
    seed: int,
) -> tuple[Bundle, RefineRequest]:
    if isinstance(bundle, str | os.PathLike):
        bundle = Bundle.open(bundle)
    check_type("bundle", bundle, Bundle, "a Bundle")
    if isinstance(cameras, Mapping):
        cameras = cameras.values()
    cameras = list(cameras)
    for number, camera in enumerate(cameras):
        check_type(f"cameras[{number}]", camera, Camera, "a Camera")
        check_pinhole(f"cameras[{number}]", camera, _UNDISTORT)
    one_of(seen_from, "seen_from", get_args(SeenFrom))
    if seen_from != "auto" and cameras:
        refuse("seen_from", f"auto with cameras, got {seen_from}")
    steps = whole(steps, "steps", "at least 1 step", 1, 1_000_000)
    drop = real(drop, "drop", "a share from 0 to 0.5", 0, 0.5)
    seed = whole(seed, "seed", "a whole number from 0 to 2^58 - 1", 0, (1 << 58) - 1)
    return bundle, RefineRequest(steps, drop, seed, seen_from, tuple(cameras))
