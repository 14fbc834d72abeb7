"""The common part of all frames that draw a scene with all gaussians resident."""

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
    """The bundles of a scene on one device. The frame does not keep the subject alive.

    Attributes:
        device: The device that draws.
        num_bundles: Number of the scene's bundles whose gaussians are on the device. It
            never decreases, because a scene never removes bundles.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.num_bundles = 0
        self._references: tuple[weakref.ref[Bundle], ...] | None = None
        self._resident: ResidentScene | None = None  # the scene as of the last picture

    @abstractmethod
    def _set_models(self, bundles: Sequence[Bundle]) -> None:
        """Set the bundles that are drawn."""

    def take(self, resident: ResidentScene) -> None:
        """Put the gaussians of the scene's bundles on the device."""
        if self._references is resident.references:  # the usual case
            return
        with residency.lock:
            bundles = resident.bundles
            if self.num_bundles < len(bundles):
                self._set_models(bundles)
                self.num_bundles = len(bundles)
            self._references = resident.references

    def _taken(self, subject: Subject) -> ResidentScene:
        """Copy the bundles of the scene to the device.

        Return the scene in its current state.
        """
        resident = residency.scene(subject, self.device, self._resident)
        self._resident = resident
        self.take(resident)
        return resident
