"""`v3dg convert`."""

import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from v3dg import _files
from v3dg._device import CPU
from v3dg._numbers import check
from v3dg._progress import waiting
from v3dg._urls import shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera
from v3dg.cleaning import AssetWarning, coarse_note
from v3dg.cli import _common
from v3dg.cli._editing import EditOptions, Editor, Edits
from v3dg.cli._faults import FaultOptions, Faults, checked
from v3dg.cli._moving import MoveOptions, Moves
from v3dg.cli._views import ViewOptions, choose_cameras
from v3dg.formats._declared import declared_of
from v3dg.gaussians import Gaussians
from v3dg.io import WRITE_SUFFIXES, turned_up, write_measured
from v3dg.scene import Scene, Subject
from v3dg.scene.file import is_scene
from v3dg.select import select
from v3dg.upright import ASSUMED, found_up, turned_upright, up_of


@dataclass
class ConvertViews(ViewOptions):
    """Options for the cameras of cuts, and for the up axis of the input."""

    up: Annotated[Axis | None, _common.option("{x,y,z,-x,-y,-z}")] = None
    """The axis of the input that points up. Gaussians are rotated so that it becomes
    -y. By default, it is the axis that `v3dg info` shows, and only outputs with defined
    axes (.spz, .glb and .usd) are rotated."""


_Views: TypeAlias = Annotated[ConvertViews, tyro.conf.OmitArgPrefixes]


@dataclass
class Convert(_common.Cut, _common.Common):
    """Write an asset, a level of a bundle, or a cut for a camera in another format; or
    write a bundle with another codec."""

    subject: tyro.conf.Positional[Path]
    """An asset in any readable format (docs/formats.md), a bundle (.v3dg) or a scene
    (.json)."""
    output: tyro.conf.Positional[Path]
    """File to write: .ply, .compressed.ply, .spz, .sog, .glb or .usd. If the subject is
    a bundle, it may also be .v3dg, which has all levels."""
    codec: Annotated[
        Literal["float32", "quantized"] | None, _common.option("{float32,quantized}")
    ] = None
    """Codec of a .v3dg output; see `v3dg build`. The default is that of the input."""
    level: Annotated[int | None, _common.option("N")] = None
    """Write this level of a bundle. By default it is 0, the asset itself, unless other
    options select a cut."""
    outside: Literal["drop", "keep"] = "drop"
    """Whether to drop or keep the part of the cut that the camera does not see."""
    spz_version: Annotated[Literal[2, 3, 4] | None, _common.option("{2,3,4}")] = None
    """Version of a .spz output. The default is 3."""
    moves: Moves = field(default_factory=MoveOptions)
    edits: Edits = field(default_factory=EditOptions)
    faults: Faults = field(default_factory=FaultOptions)
    view: _Views = field(default_factory=ConvertViews)


@dataclass(frozen=True)
class _Part:
    """The gaussians to write, and the entries of the result that describe them."""

    gaussians: Gaussians
    description: dict[str, object]


def run(options: Convert) -> None:
    # --up applies to every input, not only to views around the subject.
    replace(options.view, up=None).check(options.subject)
    options.moves.check()
    options.edits.check()
    options.faults.check()
    editor = Editor(options.edits)
    _check_output(options)
    part_options = _part_options(options)
    is_cut = is_scene(options.subject) or any(name != "--level" for name in part_options)
    expected = "no scene, camera, tolerance or budget together with it; leave out one or the other"
    _common.check_usage("--level", options.level is None or not is_cut, expected)
    start = time.perf_counter()
    with warnings.catch_warnings():
        # These warnings are part of the result.
        warnings.simplefilter("ignore", AssetWarning)
        subject, own_cameras = _common.open_subject(options.subject, show=not options.quiet)
    output = options.output
    notes: list[str] = []
    if _is_bundle(output):
        part = _write_bundle(options, subject, part_options)
    else:
        part = _part(options, subject, own_cameras, part_options, is_cut=is_cut)
        part = _written(options, subject, part, editor, notes)
    num_bytes = output.stat().st_size
    result = {
        "output": str(output),
        "gaussians": len(part.gaussians),
        "sh_degree": part.gaussians.sh_degree,
        "bytes": num_bytes,
        "seconds": time.perf_counter() - start,
        **part.description,
        "notes": notes,
        **editor.result(),
    }
    text = f"{output}: {len(part.gaussians):,} gaussians, SH degree {part.gaussians.sh_degree}"
    line = f"{text}, {_common.bytes_text(num_bytes)}"
    for note in notes:
        _common.tell(note)
    _common.print_result(result, [line, *editor.lines()], as_json=options.json)


def _written(
    options: Convert, subject: Subject, part: _Part, editor: Editor, notes: list[str]
) -> _Part:
    """Join, move, trim, check and write a part. Append lines about rotations and losses
    to `notes`. Return the written part."""
    output = options.output
    name = shown(options.subject)
    if isinstance(subject, Gaussians):
        notes += [f"{name}: {note}" for note in declared_of(subject).notes]
    gaussians = part.gaussians
    if gaussians.antialiased:
        notes.append(f"{name}: trained with antialiasing")
    up, reason, is_guessed = found_up(subject)
    if options.view.up is not None:
        gaussians = turned_upright(gaussians, options.view.up)
        reason = f"rotated from {options.view.up}, as requested by --up"
        up = "-y"
        is_guessed = False
    gaussians = options.moves.moved(editor.joined(gaussians))
    if options.moves.rotate is not None and is_guessed:
        up, reason = up_of(gaussians)
    notes += _lines_of_up(name, output, up, reason)
    remaining = checked(options.faults, editor.trimmed(gaussians), options.subject, output)
    if remaining.note:
        notes.append(remaining.note)
    gaussians = remaining.gaussians
    coarse = coarse_note(gaussians.numpy())
    if coarse is not None:
        notes.append(f"{output}: {coarse}")
    with waiting(f"writing {output}", show=not options.quiet):
        try:
            losses = write_measured(output, gaussians, up=up, version=options.spz_version)
        except ValueError as error:
            raise ValueError(f"{name}: cannot be written to {output}: {error}") from None
    description: dict[str, object] = dict(part.description)
    description |= {"up": up, "up_reason": reason, "dropped": remaining.dropped}
    if losses is not None:
        notes += [f"{output}: {line}" for line in losses.lines]
        description |= losses.result()
    return _Part(gaussians, description)


def _lines_of_up(name: str, output: Path, up: Axis, reason: str) -> list[str]:
    """Return lines about the up axis, and about its rotation in the output."""
    up_in_file = turned_up(output)
    if up_in_file is not None:
        text = f"{name}: {up} is up, {reason}; {output.name} is rotated so that {up_in_file} is up"
        return [f"{text}; change it with --up"]
    if up != "-y":
        text = f"{name}: {up} is up, {reason}; {output.name} keeps it"
        return [f"{text}, while most viewers assume -y; --up {up} rotates it"]
    if reason != ASSUMED:
        return [f"{name}: {up} is up, {reason}"]
    return []


def _is_bundle(path: Path) -> bool:
    return path.name.lower().endswith(".v3dg")


def _check_output(options: Convert) -> None:
    """Raise an error if the output cannot be written, or if options do not apply to its
    format."""
    output = options.output
    name = output.name.lower()
    suffixes = (*WRITE_SUFFIXES, ".v3dg")
    check(output, name.endswith(suffixes), f"a file name that ends in {', '.join(suffixes)}")
    fits = options.codec is None or _is_bundle(output)
    _common.check_usage("--codec", fits, f"an output that ends in .v3dg, got {output}")
    fits = not options.spz_version or name.endswith(".spz")
    _common.check_usage("--spz-version", fits, f"a .spz as output, got {output}; leave it out")
    _common.check_output(output, options.subject, *options.edits.added_paths())
    _files.make_folder(output)


def _part_options(options: Convert) -> list[str]:
    """Return the names of the given options that select a level or a cut."""
    values = {
        "--level": options.level,
        "--tolerance": options.tolerance,
        "--budget": options.budget,
        "--cameras": options.view.cameras,
        **replace(options.view, up=None).turntable(),
    }
    return [name for name, value in values.items() if value is not None]


def _write_bundle(options: Convert, subject: Subject, part_options: list[str]) -> _Part:
    changes = [*part_options, *options.moves.option_names(), *options.edits.option_names()]
    if options.view.up is not None:
        changes.append("--up")
    if not isinstance(subject, Bundle) or changes:
        raise _common.UsageError(
            f"{options.output}: expected a bundle as input, without options that select or change "
            "a part of it; `v3dg build` makes a bundle from an asset"
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
    *,
    is_cut: bool,
) -> _Part:
    """Return the asset, a level of the bundle, or a cut."""
    if isinstance(subject, Gaussians):
        expected = "a bundle or a scene, got an asset; build a bundle from it"
        _common.check_usage(", ".join(part_options), not part_options, expected)
        return _Part(subject, {})
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
    expected = f"exactly one camera, got {len(cameras)}; choose one"
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
    # Only read the pages that have clusters of the cut.
    if isinstance(subject, Bundle) and len(selection):
        gaussians = Gaussians.concatenate(
            [subject.cluster_gaussians(int(c)) for c in selection.cluster_ids]
        )
    else:
        gaussians = selection.gaussians(device=CPU)
    description: dict[str, object] = {
        "camera": name,
        "tolerance": _common.finite(selection.tolerance),
        "clusters": len(selection),
    }
    return _Part(gaussians, description)
