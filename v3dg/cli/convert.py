"""`v3dg convert`."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from v3dg import _files
from v3dg._device import CPU
from v3dg._numbers import check
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.cli import _common
from v3dg.cli._views import ViewOptions, Views, choose_cameras
from v3dg.gaussians import Gaussians
from v3dg.io import WRITE_SUFFIXES, write_asset
from v3dg.opening import open_with_cameras
from v3dg.scene import Scene
from v3dg.scene.file import is_scene
from v3dg.select import select


@dataclass
class Convert(_common.Cut, _common.Common):
    """Write an asset, a level of a bundle, or its cut for a camera, in another format; or a bundle anew."""

    subject: tyro.conf.Positional[Path]
    """An asset in any format that is read (docs/formats.md), a bundle (.v3dg) or a scene (.json)."""
    output: tyro.conf.Positional[Path]
    """File to write, .ply, .compressed.ply, .spz, .sog, .glb or .usd; of a bundle also .v3dg, with all its
    levels."""
    codec: Annotated[Literal["float32", "quantized"] | None, _common.option("{float32,quantized}")] = None
    """How a .v3dg that is written keeps gaussians, as for `v3dg build`; as the bundle does if not given."""
    level: Annotated[int | None, _common.option("N")] = None
    """Write this level of a bundle; 0, the asset itself, if no cut is asked for."""
    outside: Literal["drop", "keep"] = "drop"
    """What becomes of the part of the cut that the camera does not see."""
    spz_version: Annotated[Literal[2, 3, 4] | None, _common.option("{2,3,4}")] = None
    """Version of a .spz; 3 if not given."""
    view: Views = field(default_factory=ViewOptions)


def run(options: Convert) -> None:
    view = options.view
    view.check(options.subject)
    output, name = options.output, options.output.name.lower()
    to_bundle, suffixes = name.endswith(".v3dg"), (*WRITE_SUFFIXES, ".v3dg")
    check(output, name.endswith(suffixes), f"a file name that ends in {', '.join(suffixes)}")
    fits = options.codec is None or to_bundle
    _common.check_usage("--codec", fits, f"an output that ends in .v3dg, got {output}")
    fits = not options.spz_version or name.endswith(".spz")
    _common.check_usage("--spz-version", fits, f"a .spz to write, got {output}; leave it out")
    _files.check_folder(output)
    _common.check_output(output, options.subject)
    part: dict[str, Any] = {"--level": options.level, "--tolerance": options.tolerance}
    part |= {"--budget": options.budget, "--cameras": view.cameras, **view.turntable()}
    given = [name for name, value in part.items() if value is not None]
    is_cut = is_scene(options.subject) or any(name != "--level" for name in given)
    expected = "no scene, camera, tolerance or budget with it; leave out one or the other"
    _common.check_usage("--level", options.level is None or not is_cut, expected)
    start = time.perf_counter()
    subject, own_cameras = open_with_cameras(options.subject)
    told: dict[str, Any] = {}
    if to_bundle:
        if not isinstance(subject, Bundle) or is_cut or options.level is not None:
            expected = "a bundle to write anew, and no level or cut of it; v3dg build makes one of an asset"
            raise _common.UsageError(f"{output}: expected {expected}")
        gaussians, codec = subject.gaussians, options.codec or subject.codec
        Bundle(subject.clusters, subject.groups, gaussians, subject.config, codec).write(output)
        told = {"codec": codec}
    elif isinstance(subject, Gaussians):
        _common.check_usage(", ".join(given), not given, "a bundle or a scene; build one first")
        gaussians = subject
    elif isinstance(subject, Bundle) and not is_cut:
        level = options.level or 0
        _common.check_range("--level", level, 0, max(0, subject.num_levels - 1))
        gaussians, told = subject.level_gaussians(level), {"level": level}
    else:
        cameras = choose_cameras(view, options.subject, subject, own_cameras)
        expected = f"one camera to look from, got {len(cameras)}; choose one"
        _common.check_usage("--views" if view.views else "--camera", len(cameras) == 1, expected)
        gaussians, told = _cut(options, subject, *cameras.items())
    if not to_bundle:
        write_asset(output, gaussians, version=options.spz_version)
    result = {"output": str(output), "gaussians": len(gaussians), "sh_degree": gaussians.sh_degree}
    result |= {"bytes": output.stat().st_size, "seconds": time.perf_counter() - start, **told}
    size = _common.bytes_text(output.stat().st_size)
    text = f"{output}: {len(gaussians):,} gaussians, SH degree {gaussians.sh_degree}, {size}"
    _common.print_result(options.json, result, [text])


def _cut(
    options: Convert, subject: Scene | Bundle, named_camera: tuple[str, Camera]
) -> tuple[Gaussians, dict[str, Any]]:
    name, camera = named_camera
    how: Any = {"tolerance": options.tolerance, "budget": options.budget, "cull": options.outside == "drop"}
    selection = select(subject, camera, **how, device=CPU)
    if isinstance(subject, Bundle) and len(selection):  # its clusters alone are read
        gaussians = Gaussians.concatenate([subject.cluster_gaussians(int(c)) for c in selection.cluster_ids])
    else:
        gaussians = selection.gaussians(device=CPU)
    told = {"camera": name, "tolerance": _common.finite(selection.tolerance), "clusters": len(selection)}
    return gaussians, told
