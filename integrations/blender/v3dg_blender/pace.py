"""Decides when a new cut is due."""

from __future__ import annotations

# The pause after a cut is at least this long, and at least this many times the duration
# of the cut, so that Blender stays responsive while the view moves.
_LEAST_PAUSE_S = 0.25
_PAUSE_FACTOR = 2.0


class Pace:
    """Decides when a new cut is due, from times and a key.

    The key contains all values on which a cut depends.
    """

    def __init__(self) -> None:
        self._key: object = None
        self._not_before_s = 0.0

    def is_due(self, key: object, now_s: float) -> bool:
        """Return whether something has changed and the pause is over."""
        return key != self._key and now_s >= self._not_before_s

    def record(self, key: object, end_s: float, seconds: float) -> None:
        """Record that the cut for a key has ended and took some seconds."""
        self._key = key
        self._not_before_s = end_s + max(_LEAST_PAUSE_S, _PAUSE_FACTOR * seconds)

    def forget(self) -> None:
        """Make a new cut due, after the pause."""
        self._key = None
