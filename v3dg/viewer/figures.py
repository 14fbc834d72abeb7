"""The figures of a tab's panel, as HTML: what a picture cost, what its colours mean, its levels."""

from __future__ import annotations

from typing import Any

import numpy as np

from v3dg.false_color import LEVEL_COLORS
from v3dg.viewer.frame import MOST_COUNTED, Frame, ramp


def figures_html(frame: Frame) -> str:
    """Return a frame's figures, what its colours mean, and its gaussians by level, as HTML."""
    figures = frame.figures
    width, height = frame.size
    rows = [
        ("selected", f"{figures.gaussians_selected:,}"),
        ("in view", f"{figures.gaussians_in_view:,}"),
        ("tolerance", f"{figures.tolerance:.3g} px²"),
        ("select", f"{figures.select_ms:.1f} ms"),
        ("draw", f"{figures.draw_ms:.1f} ms"),
        ("picture", f"{width} x {height}"),
        ("memory", f"{figures.memory_bytes / (1 << 20):,.0f} MiB"),
    ]
    cells = "".join(
        f'<tr><td style="opacity:.65">{name}</td><td style="text-align:right">{value}</td></tr>'
        for name, value in rows
    )
    table = f'<table style="width:100%;border-spacing:0">{cells}</table>'
    return box(table + _legend(frame) + _levels(frame))


def _legend(frame: Frame) -> str:
    if frame.value_range is None:
        return ""
    if frame.shows == "count":
        marks = ["1", "4", "16", "64", f"{MOST_COUNTED}+"]
    else:
        low, high = frame.value_range
        marks = [f"{low:.3g}", f"{high:.3g}"]
        if frame.shows == "depth":
            marks = [f"far {marks[0]}", f"near {marks[1]}"]
    grey = np.linspace(0, 1, 7)
    colors = np.repeat(grey[:, None], 3, axis=1) if frame.shows == "alpha" else ramp(grey)
    stops = ",".join(_css(color) for color in colors)
    labels = "".join(f"<span>{mark}</span>" for mark in marks)
    return (
        f'<div style="height:8px;margin-top:6px;background:linear-gradient(90deg,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{labels}</div>'
    )


def _levels(frame: Frame) -> str:
    """Bars of the selected gaussians by level, in the colours of the levels."""
    levels = frame.figures.levels
    if len(levels) < 2:
        return ""
    most = max(int(levels.max()), 1)
    bars = "".join(
        f'<div title="level {level}: {count:,}" style="flex:1;height:{max(100 * count / most, 1):.0f}%;'
        f'background:{_css(LEVEL_COLORS[level % len(LEVEL_COLORS)])}"></div>'
        for level, count in enumerate(levels)
    )
    return (
        '<div style="display:flex;align-items:flex-end;gap:2px;height:44px;margin-top:8px">'
        f"{bars}</div>"
        '<div style="display:flex;justify-content:space-between;opacity:.65">'
        f"<span>level 0</span><span>selected by level</span><span>{len(levels) - 1}</span></div>"
    )


def box(content: str) -> str:
    """Return what the panel shows, in the letters that it has for figures."""
    return (
        f'<div style="font-size:.8em;padding:0 .9em .4em;font-variant-numeric:tabular-nums">{content}</div>'
    )


def _css(color: Any) -> str:
    red, green, blue = (round(255 * float(c)) for c in color)
    return f"rgb({red},{green},{blue})"
