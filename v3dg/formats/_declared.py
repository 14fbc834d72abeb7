"""The declarations of a file about its gaussians, beside their numbers."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians


@dataclass(frozen=True)
class Declared:
    """The declarations of a file, or of its format, about its gaussians.

    Attributes:
        up: The axis that is up among the gaussians as they are read; None if neither
            the file nor its format determines it.
        up_reason: Why `up` is what it is, as a phrase.
        antialiased: Whether opacities were trained to be compensated for the filter of
            the rasterizer; None if the file does not say.
        notes: What is in the file and was not understood, or was read otherwise than it
            is written; each is one sentence without the name of the file.
        up_is_guessed: Whether `up` is only what the gaussians themselves show.
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
    """Remember what the file of these gaussians declares; gaussians that are made from
    them declare nothing."""
    _OF_GAUSSIANS[gaussians] = declared
    return gaussians


def declared_of(gaussians: Gaussians) -> Declared:
    """Return what a file declares about the gaussians that `read_asset` returned."""
    return _OF_GAUSSIANS.get(gaussians, NOTHING)
