"""`v3dg convert`."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg import _files
from v3dg._device import CPU
from v3dg._numbers import check
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.cli import _common
from v3dg.cli._editing import EditOptions, Editor, Edits
from v3dg.cli._views import ViewOptions, Views, choose_cameras
from v3dg.gaussians import Gaussians
from v3dg.io import WRITE_SUFFIXES, write_asset
from v3dg.opening import open_with_cameras
from v3dg.scene import Scene, Subject
from v3dg.scene.file import is_scene
from v3dg.select import select


@dataclass
class Convert(_common.Cut, _common.Common):
    """Write an asset, a level of a bundle, or its cut for a camera, in another format;
    or a bundle with another codec."""

    subject: tyro.conf.Positional[Path]
    """An asset in any readable format (docs/formats.md), a bundle (.v3dg) or a scene
    (.json)."""
    output: tyro.conf.Positional[Path]
    """File to write, .ply, .compressed.ply, .spz, .sog, .glb or .usd; for a bundle also
    .v3dg, with all its levels."""
    codec: Annotated[
        Literal["float32", "quantized"] | None, _common.option("{float32,quantized}")
    ] = None
    """Codec of a .v3dg output, as for `v3dg build`; by default that of the bundle."""
    level: Annotated[int | None, _common.option("N")] = None
    """Write this level of a bundle; by default 0, the asset itself, unless other
    options choose a cut."""
    outside: Literal["drop", "keep"] = "drop"
    """Drop or keep the part of the cut that the camera does not see."""
    spz_version: Annotated[Literal[2, 3, 4] | None, _common.option("{2,3,4}")] = None
    """Version of a .spz; 3 by default."""
    view: Views = field(default_factory=ViewOptions)
    edits: Edits = field(default_factory=EditOptions)


@dataclass(frozen=True)
class _Part:
    """The gaussians to write, and the fields of the result that describe them."""

    gaussians: Gaussians
    description: dict[str, str | int | float | None]


def run(options: Convert) -> None:
    options.view.check(options.subject)
    options.edits.check()
    editor = Editor(options.edits)
    _check_output(options)
    part_options = _part_options(options)
    is_cut = is_scene(options.subject) or any(name != "--level" for name in part_options)
    expected = "no scene, camera, tolerance or budget with it; leave out one or the other"
    _common.check_usage("--level", options.level is None or not is_cut, expected)
    start = time.perf_counter()
    subject, own_cameras = open_with_cameras(options.subject)
    output = options.output
    if _is_bundle(output):
        part = _write_bundle(options, subject, part_options)
    else:
        part = _part(options, subject, own_cameras, part_options)
        part = _Part(editor.trimmed(editor.joined(part.gaussians)), part.description)
        write_asset(output, part.gaussians, version=options.spz_version)
    num_bytes = output.stat().st_size
    result = {
        "output": str(output),
        "gaussians": len(part.gaussians),
        "sh_degree": part.gaussians.sh_degree,
        "bytes": num_bytes,
        "seconds": time.perf_counter() - start,
        **part.description,
        **editor.result(),
    }
    text = f"{output}: {len(part.gaussians):,} gaussians, SH degree {part.gaussians.sh_degree}"
    line = f"{text}, {_common.bytes_text(num_bytes)}"
    _common.print_result(result, [line, *editor.lines()], as_json=options.json)


def _is_bundle(path: Path) -> bool:
    return path.name.lower().endswith(".v3dg")


def _check_output(options: Convert) -> None:
    """Refuse an output that cannot be written, and options that do not apply to its
    format."""
    output = options.output
    name = output.name.lower()
    suffixes = (*WRITE_SUFFIXES, ".v3dg")
    check(output, name.endswith(suffixes), f"a file name that ends in {', '.join(suffixes)}")
    fits = options.codec is None or _is_bundle(output)
    _common.check_usage("--codec", fits, f"an output that ends in .v3dg, got {output}")
    fits = not options.spz_version or name.endswith(".spz")
    _common.check_usage("--spz-version", fits, f"a .spz to write, got {output}; leave it out")
    _files.check_folder(output)
    _common.check_output(output, options.subject, *options.edits.added_paths())


def _part_options(options: Convert) -> list[str]:
    """The names of the options on the command line that ask for a level or a cut."""
    values = {
        "--level": options.level,
        "--tolerance": options.tolerance,
        "--budget": options.budget,
        "--cameras": options.view.cameras,
        **options.view.turntable(),
    }
    return [name for name, value in values.items() if value is not None]


def _write_bundle(options: Convert, subject: Subject, part_options: list[str]) -> _Part:
    if not isinstance(subject, Bundle) or part_options or options.edits.option_names():
        raise _common.UsageError(
            f"{options.output}: expected a bundle as the input, without options that choose a part "
            "of it; v3dg build makes a bundle from an asset"
        )
    codec = options.codec or subject.codec
    Bundle(subject.clusters, subject.groups, subject.gaussians, subject.config, codec).write(
        options.output
    )
    return _Part(subject.gaussians, {"codec": codec})


def _part(
    options: Convert,
    subject: Subject,
    own_cameras: dict[str, Camera] | None,
    part_options: list[str],
) -> _Part:
    """The asset, a level of the bundle, or a cut."""
    if isinstance(subject, Gaussians):
        expected = "a bundle or a scene; build one first"
        _common.check_usage(", ".join(part_options), not part_options, expected)
        return _Part(subject, {})
    is_cut = any(name != "--level" for name in part_options)
    if isinstance(subject, Bundle) and not is_cut:
        return _level(options, subject)
    return _cut(options, subject, own_cameras)


def _level(options: Convert, bundle: Bundle) -> _Part:
    level = options.level or 0
    _common.check_range("--level", level, 0, max(0, bundle.num_levels - 1))
    return _Part(bundle.level_gaussians(level), {"level": level})


def _cut(options: Convert, subject: Scene | Bundle, own_cameras: dict[str, Camera] | None) -> _Part:
    cameras = choose_cameras(options.view, options.subject, subject, own_cameras)
    option_name = "--camera"
    if options.view.views:
        option_name = "--views"
    expected = f"one camera to look from, got {len(cameras)}; choose one"
    _common.check_usage(option_name, len(cameras) == 1, expected)
    name, camera = next(iter(cameras.items()))
    selection = select(
        subject,
        camera,
        tolerance=options.tolerance,
        budget=options.budget,
        cull=options.outside == "drop",
        device=CPU,
    )
    if isinstance(subject, Bundle) and len(selection):  # reads only the clusters of the cut
        gaussians = Gaussians.concatenate(
            [subject.cluster_gaussians(int(c)) for c in selection.cluster_ids]
        )
    else:
        gaussians = selection.gaussians(device=CPU)
    description = {
        "camera": name,
        "tolerance": _common.finite(selection.tolerance),
        "clusters": len(selection),
    }
    return _Part(gaussians, description)
