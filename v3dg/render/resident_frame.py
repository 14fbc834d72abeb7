"""What the frames have in common that draw a scene whose gaussians are all resident."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from v3dg.residency import ResidentScene, residency

if TYPE_CHECKING:
    import weakref
    from collections.abc import Sequence

    from v3dg._device import Device
    from v3dg.bundle import Bundle
    from v3dg.scene import Subject


class ResidentFrame(ABC):
    """The bundles of a scene on one device. It does not keep the subject alive.

    Attributes:
        device: The device that draws.
        num_bundles: Number of the scene's bundles whose gaussians are on the device. A
            scene never removes bundles.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.num_bundles = 0
        self._references: tuple[weakref.ref[Bundle], ...] | None = None
        self._resident: ResidentScene | None = None  # the scene as it was last drawn

    @abstractmethod
    def _set_models(self, bundles: Sequence[Bundle]) -> None:
        """Set the bundles that are drawn."""

    def take(self, resident: ResidentScene) -> None:
        """Put the gaussians of the scene's bundles on the device."""
        if self._references is resident.references:  # true for most pictures
            return
        with residency.lock:
            bundles = resident.bundles
            if self.num_bundles < len(bundles):
                self._set_models(bundles)
                self.num_bundles = len(bundles)
            self._references = resident.references

    def _taken(self, subject: Subject) -> ResidentScene:
        """Return the scene as it is now, after taking it."""
        resident = residency.scene(subject, self.device, self._resident)
        self._resident = resident
        self.take(resident)
        return resident
