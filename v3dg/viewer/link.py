"""The place that a link of the viewer's page leads to, as `page/link_state.js` writes
it behind the `#` of its address."""

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from v3dg._numbers import check
from v3dg.viewer.view import View

_FOV_BOUNDS = (1.0, 170.0)  # degrees, as in the page
_DEFAULT_FOV = 45.0


@dataclass(frozen=True)
class LinkedPlace:
    """The camera of a link.

    Attributes:
        view: The camera; its aspect is 1, because a link has none.
        focus: (3,) the point that orbits go around, world units; None if the link has
            none.
    """

    view: View
    focus: tuple[float, float, float] | None


def read_link(link: str) -> LinkedPlace:
    """Read the camera of a link: the whole address, or what follows its `#`.

    Raises:
        ValueError: The link has no place, or a value in it is not as the page writes
            it.
    """
    values: dict[str, str] = {}
    for name, text in parse_qsl(link.rpartition("#")[2]):
        values.setdefault(name, text)
    x, y, z = _numbers(values, "at", 3)
    w, i, j, k = _numbers(values, "turn", 4)
    check(
        "link", math.hypot(w, i, j, k) > 0.5, "a rotation of length 1 in turn=, got a shorter one"
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
    """Return the numbers of a value, separated by commas."""
    text = values.get(name)
    expected = "an address that the viewer's page has in its address bar, with"
    check("link", text is not None, f"{expected} at= and turn= behind #, got none of {name}=")
    try:
        numbers = [float(part) for part in (text or "").replace(",", " ").split()]
    except ValueError:
        numbers = []
    fits = len(numbers) == count and all(map(math.isfinite, numbers))
    check("link", fits, f"{expected} {count} numbers in {name}=, got {text}")
    return numbers
