"""Vector environments of Gymnasium whose observations are pictures of a scene."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from v3dg import _device, _extras
from v3dg._numbers import check_type, floats, whole
from v3dg.camera_batch import CameraBatch
from v3dg.render import BatchPlanes, Renderer
from v3dg.scene import Scene
from v3dg.simulators._colors import bytes_of

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(_extras.missing("gymnasium")) from error

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt
    import torch


class PictureVectorEnv(VectorEnv):
    """N environments next to each other in one scene. Each has its own camera, whose
    picture is the observation.

    A subclass defines the task by implementing `start_worlds` and `step_worlds`. They
    move the instances of the scene, and write the poses of the cameras. One call draws
    the pictures of all environments. A camera sees the instances of its environment and
    the shared ones (`Scene.add(environment=)`).

    Observations (N, H, W, 3) uint8, rewards (N,) float32, and terminations and
    truncations (N,) bool are torch tensors on the device that draws. An environment
    whose episode has ended starts again in the next step, which ignores its action and
    has reward 0 (`AutoresetMode.NEXT_STEP`).

    Args:
        scene: The instances of all environments.
        num_envs: N.
        single_action_space: The actions of one environment.
        K: (3, 3) focal lengths and principal point of all cameras in px.
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        near: As in `CameraBatch`.
        max_steps: Number of steps after which an episode is truncated.
        background: Colour behind the scene.
        tolerance: As in `Renderer.render_batch`.
        device: "auto", "cpu", "cuda" or, for example, "cuda:1".

    Attributes:
        scene: The scene that was passed.
        viewmats: (N, 4, 4) float32 tensor from world to camera, which subclasses write.
        random: The torch generator on the device, which `reset(seed=)` seeds.
        device: The name of the device for torch.

    Raises:
        ImportError: torch is not installed.
        RuntimeError: The device is not available.
        ValueError: An argument is invalid.
    """

    metadata: ClassVar[dict[str, object]] = {
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": [],
    }

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        single_action_space: gymnasium.Space,
        *,
        K: npt.ArrayLike,
        width: int,
        height: int,
        near: float = 0.01,
        max_steps: int = 1000,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        tolerance: float | None = None,
        device: str = "auto",
    ) -> None:
        _extras.load("torch")
        import torch

        check_type("scene", scene, Scene, "a Scene")
        self.scene = scene
        self.num_envs = whole(num_envs, "num_envs", "a positive whole number", 1)
        shape = (height, width, 3)
        self._take_spaces(single_action_space, gymnasium.spaces.Box(0, 255, shape, np.uint8))
        self._max_steps = whole(max_steps, "max_steps", "a positive whole number", 1)
        self._background = background
        self._tolerance = tolerance
        place = _device.resolve(device)
        self.device = str(place)
        self._renderer = Renderer(scene, device=place, memory=None)
        self.random = torch.Generator(self.device)
        self.viewmats = torch.eye(4, device=self.device).repeat(num_envs, 1, 1)
        self._K = floats(K, "K")
        self._near = near
        self._cameras = CameraBatch(
            self.viewmats, self._K, width, height, near, environments=np.arange(num_envs)
        )
        self._planes: BatchPlanes | None = None
        if place.is_cuda:
            self._planes = BatchPlanes(torch.empty(num_envs, *shape, device=self.device))
        self._has_ended = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._num_steps = self._has_ended.int()

    def _take_spaces(self, actions: gymnasium.Space, observations: gymnasium.Space) -> None:
        self.single_action_space = actions
        self.action_space = batch_space(actions, self.num_envs)
        self.single_observation_space = observations
        self.observation_space = batch_space(observations, self.num_envs)

    @abstractmethod
    def start_worlds(self, is_new: torch.Tensor) -> None:
        """Put some environments into an initial state: their instances, and their rows
        of `viewmats`.

        Args:
            is_new: (N,) bool, the environments to start. The others must not change.
                Use masks (`torch.where`) instead of indices, which would wait for the
                device.
        """

    @abstractmethod
    def step_worlds(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance all environments by one step.

        Args:
            actions: (N, ...) tensor on the device.

        Returns:
            (N,) rewards, and (N,) bool whether an episode has reached its final state.
        """

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[torch.Tensor, dict[str, object]]:
        """Start all environments, and return their observations and an empty dict.

        Args:
            seed: Seed of `random`. None continues its sequence.
            options: Not used.
        """
        if seed is not None:
            self.random.manual_seed(seed)
        self._num_steps.zero_()
        self._has_ended.zero_()
        self.start_worlds(~self._has_ended)
        return self._observations(), {}

    def step(
        self, actions: torch.Tensor | npt.ArrayLike
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, object]]:
        """Take a step in all environments.

        Args:
            actions: (N, ...) tensor or array.

        Returns:
            Observations, rewards, terminations, truncations and an empty dict.
        """
        import torch

        is_new = self._has_ended
        rewards, has_terminated = self.step_worlds(torch.as_tensor(actions, device=self.device))
        self.start_worlds(is_new)
        self._num_steps = torch.where(is_new, 0, self._num_steps + 1)
        rewards = torch.where(is_new, 0.0, rewards)
        terminations = has_terminated & ~is_new
        truncations = (self._num_steps >= self._max_steps) & ~terminations
        self._has_ended = terminations | truncations
        return self._observations(), rewards, terminations, truncations, {}

    def _observations(self) -> torch.Tensor:
        """Draw the pictures of all environments."""
        import torch

        cameras = self._cameras
        if self._planes is None:
            # On the host, a batch of cameras is a copy.
            cameras = CameraBatch(
                self.viewmats,
                self._K,
                cameras.width,
                cameras.height,
                self._near,
                environments=cameras.environments,
            )
        pictures = self._renderer.render_batch(
            cameras, background=self._background, tolerance=self._tolerance, out=self._planes
        )
        return bytes_of(torch.as_tensor(pictures.color))
