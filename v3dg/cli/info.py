"""`v3dg info`."""

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import tyro

from v3dg._json import Json, JsonObject
from v3dg._urls import is_url, shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera
from v3dg.cleaning import OUTLIER_DISTANCE, Findings, describe, examine, has_no_rotation, outliers
from v3dg.cli import _common
from v3dg.formats._declared import declared_of
from v3dg.framing import frame_subject
from v3dg.gaussians import Array, Gaussians
from v3dg.io import asset_bytes
from v3dg.levels import BuildConfig
from v3dg.scene import Scene, Subject
from v3dg.upright import direction_of, up_of

# A description as a JSON object, and as lines of text.
_Description: TypeAlias = tuple[JsonObject, list[str]]

# Maximum number of cameras that are listed, so that the other lines stay on the screen.
_MOST_SHOWN = 20


@dataclass
class Info(_common.Common):
    """Describe an asset (.ply, .spz, ...), a bundle (.v3dg) or a scene (.json)."""

    file: tyro.conf.Positional[Path]
    """File to describe."""


def run(options: Info) -> None:
    _common.require_subject(options.file)
    subject, cameras = _common.open_subject(options.file, show=not options.quiet)
    if isinstance(subject, Scene):
        description = _scene_info(options.file, subject, cameras or {})
    elif isinstance(subject, Bundle):
        description = _bundle_info(subject)
    else:
        description = _asset_info(options.file, subject)
    result, lines = description
    up, reason = up_of(subject, cameras)
    result = {**result, "up": up, "up_reason": reason}
    lines.insert(1, f"{up} is up, {reason}")
    if not cameras and not is_url(options.file):
        first_view, line = _first_view(subject, up)
        result["first_view"] = first_view
        lines.append(line)
    _common.print_result(result, lines, as_json=options.json)


def _first_view(subject: Subject, up: Axis) -> tuple[JsonObject | None, str]:
    """Return the camera that shows a subject by default, as in `v3dg render` and in the
    viewer. Return None if the pages that it needs are damaged."""
    try:
        framing = frame_subject(subject)
    except (OSError, ValueError) as error:
        return None, f"first view unknown ({error})"
    camera = framing.camera(direction_of(up), 800, 800)
    eye = camera.position.tolist()
    target = framing.focus(camera).tolist()
    side = "outside"
    if framing.is_inside:
        side = "inside, as a room"
    view: JsonObject = {"eye": eye, "target": target, "is_inside": framing.is_inside}
    return view, f"first seen from {side}, from {_point(eye)} to {_point(target)}"


def _asset_info(path: Path, asset: Gaussians) -> _Description:
    num_bytes = asset_bytes(path)
    declared = declared_of(asset)
    findings = examine(asset)
    drawable = asset.subset(findings.drawable)
    far = outliers(drawable.means)
    boxes = {"box": _box(drawable.means), "box_without_outliers": _box(drawable.means[~far])}
    values = {"longest_scale": drawable.scales.max(axis=1), "opacity": drawable.opacities}
    spread = {
        name: np.percentile(array, (5, 50, 95)).tolist()
        for name, array in values.items()
        if len(array)
    }
    result: JsonObject = {
        "path": shown(path),
        "kind": "asset",
        "gaussians": len(asset),
        "drawable": len(drawable),
        "not_drawable": findings.counts,
        "without_rotation": int(has_no_rotation(asset).sum()),
        "outliers": int(far.sum()),
        "sh_degree": asset.sh_degree,
        "bytes": num_bytes,
        **boxes,
        "percentiles_5_50_95": spread,
        "antialiased": declared.antialiased,
        "notes": list(declared.notes),
    }
    lines = [f"{shown(path)}: asset, {_common.bytes_text(num_bytes)}"]
    lines += [f"{len(asset):,} gaussians, SH degree {asset.sh_degree}"]
    lines += _fault_lines(findings, result["without_rotation"])
    lines += [*_extent_lines(result), *_spread_lines(spread)]
    if declared.antialiased:
        lines.append("trained with antialiasing")
    return result, lines


def _fault_lines(findings: Findings, num_unrotated: int) -> list[str]:
    """Return lines about gaussians that cannot be drawn, or that are drawn without
    their rotation."""
    lines = []
    if findings.counts:
        lines.append(f"{findings.num_dropped:,} cannot be drawn: {describe(findings.counts)}")
    if num_unrotated:
        lines.append(
            f"{num_unrotated:,} with a rotation of length zero, drawn without rotation; convert "
            "--drop-bad leaves them out"
        )
    return lines


def _extent_lines(result: JsonObject) -> list[str]:
    """Return lines about the positions of drawable gaussians."""
    lines = []
    if result["drawable"]:
        lines.append("means from {} to {}".format(*map(_point, result["box"])))
    if result["outliers"]:
        lines.append(
            "without outliers from {} to {}".format(*map(_point, result["box_without_outliers"]))
        )
        lines.append(
            f"{result['outliers']:,} outliers, {OUTLIER_DISTANCE:g} median distances from the "
            "median or farther"
        )
    return lines


def _spread_lines(spread: Mapping[str, Sequence[float]]) -> list[str]:
    """Return lines about the percentiles of values."""
    lines = []
    for name, (p5, p50, p95) in spread.items():
        text = name.replace("_", " ")
        lines.append(f"{text}: 5 % below {p5:.3g}, half below {p50:.3g}, 95 % below {p95:.3g}")
    return lines


def _box(means: Array) -> list[list[float]]:
    """Return the minimum and the maximum corner of positions. If there are no
    positions, return an empty list."""
    if not len(means):
        return []
    return [means.min(axis=0).tolist(), means.max(axis=0).tolist()]


def _point(values: list[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def _bundle_info(bundle: Bundle) -> _Description:
    result = {**bundle.info(), "kind": "bundle"}
    columns = [
        _common.Column("level", "{level}"),
        _common.Column("clusters", "{clusters:,}"),
        _common.Column("gaussians", "{gaussians:,}"),
        _common.Column("size", "{size}"),
        _common.Column("colour error", "{error_color:.4f}"),
        _common.Column("alpha error", "{error_alpha:.4f}"),
    ]
    levels = [{**level, "size": _common.bytes_text(level["bytes"])} for level in result["levels"]]
    leaves = _leaves(bundle)
    density = ""
    if leaves:
        density = f", {result['bytes'] / leaves:.1f} bytes a gaussian of level 0"
    lines = [
        f"{result['path']}: bundle, version {result['version']} ({result['codec']}), "
        f"{_common.bytes_text(result['bytes'])}{density}",
        f"{bundle.num_gaussians:,} gaussians, SH degree {bundle.sh_degree}, "
        f"{len(bundle.clusters):,} clusters, {len(bundle.groups):,} groups, "
        f"{result['num_pages']:,} pages",
        "",
        *_common.table_lines(columns, levels),
        "",
        "errors: mean error per pixel of the fits, at the size at which a level is drawn",
    ]
    if bundle.config:
        text = _common.printable(_config_text(bundle.config))
        lines += textwrap.wrap(text, 100, break_on_hyphens=False)
    return result, lines


def _config_text(config: JsonObject) -> str:
    """Return a line about the settings of a build that differ from the defaults."""
    defaults = asdict(BuildConfig().of_asset(antialiased=None))
    changes = []
    for name, value in _settings(config):
        if name not in defaults or value != defaults[name]:
            text = value
            if not isinstance(value, str):
                text = json.dumps(value)
            changes.append(f"{name}={text}")
    if not changes:
        return "built with default settings"
    return f"built with {', '.join(changes)}; all other settings are the defaults"


def _leaves(bundle: Bundle) -> int:
    """Return the number of gaussians in level 0."""
    if not len(bundle.level_range(0)):
        return 0
    return _common.level_size(bundle, 0)


def _scene_info(path: Path, scene: Scene, cameras: dict[str, Camera]) -> _Description:
    counts = np.bincount(scene.instance_bundle, minlength=len(scene.bundles)).tolist()
    bundles: list[JsonObject] = [
        {"path": shown(bundle.path or ""), "instances": count, "asset_gaussians": _leaves(bundle)}
        for bundle, count in zip(scene.bundles, counts, strict=True)
    ]
    total = sum(bundle["instances"] * bundle["asset_gaussians"] for bundle in bundles)
    sizes = [
        {"name": name, "width": camera.width, "height": camera.height}
        for name, camera in cameras.items()
    ]
    result = {
        "path": str(path),
        "kind": "scene",
        "instances": len(scene),
        "gaussians_at_full_detail": total,
        "bundles": bundles,
        "cameras": sizes,
    }
    columns = [
        _common.Column("bundle", "{path:s}"),
        _common.Column("instances", "{instances:,}"),
        _common.Column("asset gaussians", "{asset_gaussians:,}"),
    ]
    camera_columns = [
        _common.Column("camera", "{name}"),
        _common.Column("size", "{width} x {height}"),
    ]
    lines = [
        f"{path}: scene, {len(scene):,} instances, {total:,} gaussians at full detail",
        "",
        *_common.table_lines(columns, bundles),
    ]
    if sizes:
        lines += ["", *_common.table_lines(camera_columns, sizes[:_MOST_SHOWN])]
    if len(sizes) > _MOST_SHOWN:
        lines += [f"and {len(sizes) - _MOST_SHOWN:,} more; --json lists all"]
    return result, lines


def _settings(config: JsonObject, prefix: str = "") -> Iterator[tuple[str, Json]]:
    """Yield the names and values in a bundle's config. Names in nested objects get a
    prefix, except for those of the build's settings."""
    for name, value in config.items():
        if isinstance(value, dict):
            nested_prefix = f"{name} "
            if name == "build":
                nested_prefix = ""
            yield from _settings(value, nested_prefix)
        else:
            yield f"{prefix}{name}", value
