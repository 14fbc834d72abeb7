"""Makes the figures of docs/how_it_works.md and docs/choosing.md. The script needs the
extra `bench`, and takes a minute.

v3dg draws the pictures of an asset that the script generates. The curves are recorded
results.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import v3dg

# to import benchmarks/ of this checkout
sys.path.append(str(Path(__file__).resolve().parents[2]))
from benchmarks.worlds.procedural import make_asset, place_field
from v3dg.pictures import contact_sheet, to_8bit, write_picture
from v3dg.select import DEFAULT_TOLERANCE

HERE = Path(__file__).parent
RESULTS = HERE.parent.parent / "benchmarks" / "results"

LEVELS = (0, 2, 4, 6, 8)
SIDE = 230
SKY = (0.80, 0.86, 0.90)
# Colours that are legible on the light and on the dark web pages of the site.
INK, FINE, COARSE, OTHER = "#8a919c", "#2f9e6e", "#e08e2b", "#7d8fd6"
STYLE = {
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "svg.hashsalt": "v3dg",
    "font.size": 10,
}


def main() -> None:
    bundle = v3dg.build_bundle(make_asset(40_000), device="cpu")
    levels(bundle)
    cut(bundle)
    with plt.rc_context(STYLE):
        tree()
        tolerance()


def levels(bundle: v3dg.Bundle) -> None:
    """Draw the levels of one asset at one size, once with their own colours and once
    with a colour per cluster."""
    camera = v3dg.Camera.look_at((1.6, -2.4, 1.5), (0, 0, 0.35), width=SIDE, height=SIDE)
    rows = []
    for color_by in ("appearance", "cluster"):
        row = []
        for level in LEVELS:
            image = v3dg.render(
                bundle,
                camera,
                tolerance=0,
                min_level=level,
                color_by=color_by,
                background=SKY,
                device="cpu",
            )
            count = image.stats.gaussians_selected
            row.append(
                (f"level {level}: {count:,} gaussians" if color_by == "appearance" else "", image)
            )
        rows.append([(text, to_8bit(image.color)) for text, image in row])
    write_picture(HERE / "how_levels.jpg", contact_sheet(rows))


def cut(bundle: v3dg.Bundle) -> None:
    """Draw a field of instances, once with their own colours and once with a colour per
    level."""
    scene = v3dg.Scene()
    positions, quaternions, scales = place_field(1500, seed=0)
    scene.add(bundle, positions=positions, quaternions=quaternions, scales=scales)
    camera = v3dg.Camera.look_at((7, -17, 5.0), (-2, 4, -1.0), width=575, height=360)
    row = []
    for color_by, text in (
        ("appearance", "what is drawn"),
        ("level", "the level of each cluster in the cut"),
    ):
        image = v3dg.render(scene, camera, color_by=color_by, background=SKY, device="cpu")
        row.append(
            (
                f"{text}: {image.stats.gaussians_selected / 1e6:.1f} M of "
                f"{1500 * 40_000 / 1e6:.0f} M gaussians"
                if color_by == "appearance"
                else text,
                to_8bit(image.color),
            )
        )
    write_picture(HERE / "how_cut.jpg", contact_sheet([row]))


def tree() -> None:
    """Draw the clusters of four levels over one asset, and the cut for a camera at the
    left."""
    figure, axes = plt.subplots(figsize=(7.6, 3.1))
    num_leaves, height = 8, 4
    drawn = {
        (0, 0),
        (0, 1),
        (1, 1),
        (2, 1),
    }  # (level, position): fine near the camera and coarse far from it
    for level in range(height):
        width = 2**level
        for place in range(num_leaves // width):
            left, is_drawn = place * width + 0.06, (level, place) in drawn
            box = plt.Rectangle(
                (left, level + 0.1),
                width - 0.12,
                0.5,
                linewidth=1.4,
                facecolor=FINE if is_drawn else "none",
                edgecolor=INK,
                alpha=1.0 if is_drawn else 0.75,
            )
            axes.add_patch(box)
            if level + 1 < height:
                x, up = (place + 0.5) * width, (place // 2 + 0.5) * 2 * width
                axes.plot([x, up], [level + 0.6, level + 1.1], color=INK, linewidth=1, zorder=0)
        axes.text(
            num_leaves + 0.2,
            level + 0.35,
            f"level {level}: {num_leaves // width} x 256",
            va="center",
        )
    axes.plot(
        [-0.05, 2.0, 2.0, 4.0, 4.0, 8.05],
        [0.85, 0.85, 1.85, 1.85, 2.85, 2.85],
        color=COARSE,
        linestyle="--",
        linewidth=1.5,
    )
    axes.text(8.2, 2.85, "the cut", va="center", color=COARSE)
    axes.plot([-1.05], [0.35], marker=">", markersize=14, color=INK)
    axes.text(-1.05, 0.85, "camera", ha="center", va="center")
    axes.set(xlim=(-1.7, 10.3), ylim=(-0.05, height - 0.2))
    axes.axis("off")
    save(figure, "how_tree.svg")


def tolerance() -> None:
    """Plot time against error for the paper's DonutSea, as recorded on a GPU."""
    rows: list[dict[str, Any]] = json.loads((RESULTS / "full" / "tolerance.json").read_text())[
        "rows"
    ]
    figure, axes = plt.subplots(figsize=(6.4, 3.6))
    # The curve is nearly horizontal at its lowest point, so labels are below it there,
    # and beside it elsewhere.
    beside = {
        0.5: (12, -8),
        1: (10, -8),
        2: (10, -8),
        3: (4, -16),
        4.4: (-4, -16),
        8: (-8, -12),
        16: (10, 0),
    }
    for name, color, label in (
        ("ours", FINE, "v3dg, with the tolerance in px²"),
        ("paper", OTHER, "the paper's levels"),
    ):
        mine = [row for row in rows if row["levels"] == name]
        x, y = (np.array([row[key] for row in mine]) for key in ("drawn_ms", "drawn_flip"))
        axes.plot(x, y, marker="o", color=color, label=label)
        for row in mine if name == "ours" else ():
            is_default = row["tolerance"] == DEFAULT_TOLERANCE
            axes.annotate(
                f"{row['tolerance']:g} px²" + (" (default)" if is_default else ""),
                (row["drawn_ms"], row["drawn_flip"]),
                color=color,
                xytext=beside[row["tolerance"]],
                textcoords="offset points",
                ha="center"
                if is_default
                else "left"
                if beside[row["tolerance"]][0] > 0
                else "right",
                fontweight="bold" if is_default else "normal",
            )
    full = next(row for row in rows if row["levels"] == "full")
    axes.plot(
        full["drawn_ms"],
        full["drawn_flip"],
        marker="s",
        color=COARSE,
        linestyle="",
        label="every gaussian, 0 px²",
    )
    axes.set(
        xlabel="milliseconds a frame",
        ylabel="FLIP, less is better",
        ylim=(0.03, 0.08),
        xlim=(1.5, 6.6),
    )
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    save(figure, "choosing_tolerance.svg")


def save(figure: Any, name: str) -> None:
    figure.savefig(HERE / name, transparent=True, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
