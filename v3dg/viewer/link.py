"""Reads the camera in a link to the viewer's web page. `page/link_state.js` writes it
after the `#` of the address."""

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from v3dg._numbers import check
from v3dg.viewer.view import View

_FOV_BOUNDS = (1.0, 170.0)  # degrees; the limits are those of the web page
_DEFAULT_FOV = 45.0


@dataclass(frozen=True)
class LinkedPlace:
    """The camera in a link.

    Attributes:
        view: The viewpoint. Its aspect ratio is 1, because links do not contain one.
        focus: (3,) the point that the camera orbits, in world units. None if the link
            does not contain it.
    """

    view: View
    focus: tuple[float, float, float] | None


def read_link(link: str) -> LinkedPlace:
    """Read the camera in a link. The link is the whole address, or the part after its
    `#`.

    Raises:
        ValueError: The link has no camera, or a value in it is invalid.
    """
    values: dict[str, str] = {}
    for name, text in parse_qsl(link.rpartition("#")[2]):
        values.setdefault(name, text)
    x, y, z = _numbers(values, "at", 3)
    w, i, j, k = _numbers(values, "turn", 4)
    check(
        "link",
        math.hypot(w, i, j, k) > 0.5,
        ("a quaternion of length 1 in turn=, got a shorter one; copy the whole address"),
    )
    focus = None
    if "focus" in values:
        focus_x, focus_y, focus_z = _numbers(values, "focus", 3)
        focus = (focus_x, focus_y, focus_z)
    fov = _DEFAULT_FOV
    if "fov" in values:
        low, high = _FOV_BOUNDS
        fov = min(max(_numbers(values, "fov", 1)[0], low), high)
    return LinkedPlace(View((w, i, j, k), (x, y, z), math.radians(fov), 1.0), focus)


def _numbers(values: dict[str, str], name: str, count: int) -> list[float]:
    """Return the comma-separated numbers of a value in a link."""
    text = values.get(name)
    expected = "the address of the viewer's page, with"
    check("link", text is not None, f"{expected} at= and turn= after #, got one without {name}=")
    try:
        numbers = [float(part) for part in (text or "").replace(",", " ").split()]
    except ValueError:
        numbers = []
    fits = len(numbers) == count and all(map(math.isfinite, numbers))
    check("link", fits, f"{expected} {count} numbers in {name}=, got {text}")
    return numbers
