"""What a file declares about its gaussians, apart from their values."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians


@dataclass(frozen=True)
class Declared:
    """What a file, or its format, declares about its gaussians.

    Attributes:
        up: The axis that points up, in the coordinates of the gaussians in memory. It
            is None if neither the file nor its format determines it.
        up_reason: The source of `up`, as a phrase for messages.
        antialiased: Whether the gaussians were trained with opacities that compensate
            for the filter of the rasterizer. It is None if the file does not declare
            it.
        notes: Sentences about content of the file that was ignored or converted. They
            do not contain the name of the file.
        up_is_guessed: Whether `up` was only inferred from the gaussians.
    """

    up: Axis | None = None
    up_reason: str = ""
    antialiased: bool | None = None
    notes: tuple[str, ...] = ()
    up_is_guessed: bool = False


NOTHING = Declared()
"""The declarations of a file that declares nothing."""

_OF_GAUSSIANS: WeakKeyDictionary[Gaussians, Declared] = WeakKeyDictionary()


def declare(gaussians: Gaussians, declared: Declared) -> Gaussians:
    """Store what the file of these gaussians declares. Gaussians derived from them do
    not inherit the declarations."""
    _OF_GAUSSIANS[gaussians] = declared
    return gaussians


def declared_of(gaussians: Gaussians) -> Declared:
    """Return what a file declares about the gaussians that `read_asset` returned."""
    return _OF_GAUSSIANS.get(gaussians, NOTHING)
