"""What the comments of a `.ply` declare: whether trainers antialiased.

Brush and splat-transform write `SplatRenderMode: default`, `mip` or `2dgs`, Postshot
`postshot.anti_aliasing=0` or `1`, and programs that follow it `antialiased 0` or `1`.
The last of them counts, whatever its case, as in Brush and splat-transform.
"""

import re
from collections.abc import Iterable

from v3dg.formats._declared import Declared

_MODE = re.compile(r"splatrendermode:\s*(\S+)$")
_FLAG = re.compile(r"(?:postshot\.anti_aliasing\s*=\s*|antialiased\s+)([01])$")
_MODES: dict[str, bool | None] = {"default": False, "mip": True, "2dgs": None}


def declared_by(comments: Iterable[str]) -> Declared:
    """What comments declare, without the word `comment`."""
    antialiased = None
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
    return Declared(antialiased=antialiased, notes=tuple(notes))


def comments_for(antialiased: bool | None) -> list[str]:  # noqa: FBT001
    """The comments of a file that declares whether trainers antialiased."""
    if antialiased is None:
        return []
    mode = "default"
    if antialiased:
        mode = "mip"
    return [f"SplatRenderMode: {mode}"]
