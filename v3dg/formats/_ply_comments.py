"""Reads and writes comments of a `.ply` that declare antialiasing and the axis that
points up.

Brush and splat-transform write `SplatRenderMode: default`, `mip` or `2dgs`. Postshot
writes `postshot.anti_aliasing=0` or `1`, and some other programs `antialiased 0` or
`1`. As in Brush and splat-transform, case is ignored and the last of these comments
counts. nerfstudio writes `Vertical Axis: z`.
"""

import re
from collections.abc import Iterable

from v3dg.cameras import AXES, Axis
from v3dg.formats._declared import Declared

_MODE = re.compile(r"splatrendermode:\s*(\S+)$")
_FLAG = re.compile(r"(?:postshot\.anti_aliasing\s*=\s*|antialiased\s+)([01])$")
_AXIS = re.compile(r"vertical axis:\s*(\S+)$")
_MODES: dict[str, bool | None] = {"default": False, "mip": True, "2dgs": None}


def declared_by(comments: Iterable[str]) -> Declared:
    """Return what comments declare.

    The word `comment` must have been removed from them.
    """
    antialiased = None
    up: Axis | None = None
    notes = []
    for comment in comments:
        text = comment.strip().lower()
        if mode := _MODE.match(text):
            if mode[1] in _MODES:
                antialiased = _MODES[mode[1]]
            else:
                notes.append(f"Its SplatRenderMode {mode[1][:40]} is unknown, and is not used.")
        elif flag := _FLAG.match(text):
            antialiased = flag[1] == "1"
        elif axis := _AXIS.match(text):
            up = _axis_named(axis[1])
            if up is None:
                notes.append(f"Its header has an unknown vertical axis, {axis[1][:20]!a}.")
    reason = ""
    if up is not None:
        reason = "as its header says"
    return Declared(up, reason, antialiased, tuple(notes))


def _axis_named(name: str) -> Axis | None:
    for axis in AXES:
        if axis == name:
            return axis
    return None


def comments_for(antialiased: bool | None) -> list[str]:  # noqa: FBT001
    """Return the comments of a file that declares whether its gaussians are
    antialiased."""
    if antialiased is None:
        return []
    mode = "default"
    if antialiased:
        mode = "mip"
    return [f"SplatRenderMode: {mode}"]
