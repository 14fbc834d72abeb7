"""The error at each tolerance: cuts of each asset at several sizes, in comparison with
all gaussians.

    python -m benchmarks.studies.tolerances ASSETS -o tolerances_cpu

ASSETS is a folder as for `benchmarks.studies.pairs`. An object is drawn at the widths
at which its ball fills the picture; a scene is drawn from its cameras at the same
widths. Cuts, and all gaussians at one sample per pixel, are compared with all gaussians
at 4 x 4 samples per pixel (8 x 8 for small pictures). The table has FLIP of the cut
relative to that of all gaussians, the difference of their PSNR, and the number of
gaussians in the frustum relative to all of them.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.studies.pairs.subject import Subject, scaled
from v3dg import _device
from v3dg._judges import Judges
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, to_8bit

Row = dict[str, Any]

_FEW_PX = 128  # width below which the reference has 8 x 8 samples per pixel


@dataclass
class Config:
    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results, without suffix."""
    only: tuple[str, ...] = ()
    """Names of the assets to measure; by default all."""
    tolerances: tuple[float, ...] = (1.5, 3.0, 4.5, 6.0, 9.0, 12.0)
    widths: tuple[int, ...] = (512, 256, 128, 64, 32)
    """Widths of the pictures in px."""
    views: int = 4
    refine: int = 0
    """Steps of a refinement to measure as well; 0 for none."""
    device: str = "auto"


def measure(config: Config, subject: Subject, judges: Judges) -> list[Row]:
    """Return means over the views for each width and tolerance. Tolerance 0 draws all
    gaussians."""
    found: dict[tuple[int, float], list[Row]] = {}
    for (about, _, _), errors in judges.measured(_drawn(config, subject), _errors):
        found.setdefault((about["width"], about["tolerance"]), []).append({**about, **errors})
    rows = []
    for (width, tolerance), views in found.items():
        row: Row = {"asset": subject.name, "width": width, "tolerance": tolerance}
        for name in ("flip", "psnr", "ssim", "share"):
            row[name] = float(f"{statistics.fmean(view[name] for view in views):.6g}")
        rows.append(row)
    return rows


def _drawn(config: Config, subject: Subject) -> Iterator[tuple[Row, Picture, Picture]]:
    device = "cuda" if _device.resolve(config.device).is_cuda else "cpu"
    bundle = v3dg.build_bundle(subject.asset, device=device, progress=False, quality="draft")
    if config.refine > 0:
        bundle = v3dg.refine_bundle(bundle, steps=config.refine, device=device, progress=False)
    for width in config.widths:
        for view in subject.cameras:
            camera = scaled(view, width / view.width)
            truth = draw_truth(subject.asset, camera, device, 8 if width <= _FEW_PX else 4)
            for tolerance in (0.0, *config.tolerances):
                image = v3dg.render(bundle, camera, tolerance=tolerance, device=device)
                if tolerance == 0:
                    whole = image.stats.gaussians_in_frustum
                share = image.stats.gaussians_in_frustum / max(whole, 1)
                yield (
                    {"width": width, "tolerance": tolerance, "share": share},
                    truth,
                    to_8bit(image.color),
                )


def _errors(item: tuple[Row, Picture, Picture]) -> Row:
    return errors_of(item[1], item[2])


def summary(rows: list[Row]) -> str:
    """Return a row per tolerance, with means over assets and widths, and the worst
    case."""
    whole = {(row["asset"], row["width"]): row for row in rows if row["tolerance"] == 0}
    lines = []
    for tolerance in sorted({row["tolerance"] for row in rows} - {0.0}):
        here = [row for row in rows if row["tolerance"] == tolerance]
        ratio = {
            (r["asset"], r["width"]): r["flip"] / whole[r["asset"], r["width"]]["flip"]
            for r in here
        }
        worst = max(ratio, key=lambda key: ratio[key])
        line: Row = {"tolerance": tolerance, "mean": statistics.geometric_mean(ratio.values())}
        line["held"] = statistics.fmean(value <= 1 for value in ratio.values())
        line |= {"worst": ratio[worst], "where": f"{worst[0]}, {worst[1]} px"}
        line["psnr"] = statistics.fmean(
            r["psnr"] - whole[r["asset"], r["width"]]["psnr"] for r in here
        )
        line |= {name: statistics.fmean(row[name] for row in here) for name in ("flip", "share")}
        lines.append(line)
    return markdown(_SUMMARY, lines)


_SUMMARY = (
    Column("tolerance", "tolerance", "g"),
    Column("FLIP, cut / all gaussians: mean", "mean", ".3f"),
    Column("at most 1", "held", ".0%"),
    Column("worst", "worst", ".2f"),
    Column("where", "where"),
    Column("PSNR, cut less all, dB", "psnr", "+.2f"),
    Column("FLIP", "flip", ".4f"),
    Column("gaussians drawn", "share", ".0%"),
)


def main(config: Config) -> None:
    about = json.loads((config.assets / "assets.json").read_text(encoding="utf-8"))
    rows: list[Row] = []
    judges = Judges()
    try:
        for name in config.only or about:
            rows += measure(config, Subject(config.assets, name, about[name], config.views), judges)
            settings = {"widths": config.widths, "views": config.views, "refine": config.refine}
            record.write(config.output, {"settings": settings, "rows": rows}, config.device)
            print(f"{name} done", flush=True)
    finally:
        judges.close()
    print(summary(rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
