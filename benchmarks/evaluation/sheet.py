"""Pictures side by side with a line of text above each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v3dg.bench.measure import Picture

_GAP, _LINE = 6, 18
_PAPER, _INK = (16, 18, 22), (238, 240, 243)


def crop(picture: Picture, side: int) -> Picture:
    """The middle of a picture, at most so many px wide and high."""
    height, width = picture.shape[:2]
    top, left = max(0, (height - side) // 2), max(0, (width - side) // 2)
    return picture[top : top + side, left : left + side]


def sheet(rows: Sequence[Sequence[tuple[str, Picture]]]) -> Picture:
    """Rows of (text, picture), all pictures of a row of one height, as one picture."""
    from PIL import Image, ImageDraw, ImageFont

    heights = [max(picture.shape[0] for _, picture in row) for row in rows]
    widths = [sum(picture.shape[1] + _GAP for _, picture in row) for row in rows]
    canvas = Image.new("RGB", (max(widths) + _GAP, sum(h + _LINE + _GAP for h in heights) + _GAP), _PAPER)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(12)
    top = _GAP
    for row, height in zip(rows, heights, strict=True):
        left = _GAP
        for text, picture in row:
            draw.text((left, top), text, font=font, fill=_INK)
            canvas.paste(Image.fromarray(picture), (left, top + _LINE))
            left += picture.shape[1] + _GAP
        top += height + _LINE + _GAP
    return np.asarray(canvas)
