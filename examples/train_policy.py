"""Trains a policy that drives to a red donut and avoids a blue one, from pixels. One
call per step draws many environments in one scene. The algorithm is PPO in plain torch.

    pip install '.[gymnasium]'
    python examples/train_policy.py --device cuda

The example prints the mean return of an episode with random actions, and that of the
policy while it learns. It also writes the pictures that one robot sees in an episode,
as a strip.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import torch
import tyro
from torch import nn

import v3dg
from v3dg.donut import make_donut
from v3dg.pictures import write_picture
from v3dg.simulators.gymnasium import PictureVectorEnv

TURN = math.radians(18)  # rotation of a step
STRIDE = 0.3  # distance of a step in world units
REACH = 0.8  # distance at which a donut is reached
EYE_HEIGHT = 0.5
GOAL_TINT = (1.0, 0.25, 0.2)
TRAP_TINT = (0.25, 0.4, 1.0)
SKY = (0.75, 0.83, 0.9)


@dataclass
class Config:
    """Train a policy that drives to a red donut, from pixels."""

    envs: int = 1024
    """Number of environments side by side."""
    size: int = 48
    """Width and height of the pictures in px."""
    gaussians: int = 20_000
    """Number of gaussians of a donut."""
    steps: int = 16
    """Number of steps in every environment between two updates."""
    updates: int = 60
    """Number of updates of the policy."""
    max_steps: int = 24
    """Maximum number of steps of an episode."""
    seed: int = 0
    device: str = "auto"
    """Device that draws and trains: auto, cpu or cuda."""
    output: Path | None = Path("policy.png")
    """Strip of pictures to write."""


class DriveToDonut(PictureVectorEnv):
    """An environment in which a robot with a camera turns and drives, and a red and a
    blue donut are on the ground. The reward of a step is the decrease of the distance
    to the red donut. Reaching this donut adds 2, and reaching the blue one subtracts 2.
    Either ends the episode."""

    def __init__(self, donut: v3dg.Bundle, config: Config) -> None:
        scene = v3dg.Scene()
        count = config.envs
        environments = np.arange(count)
        for tint in (GOAL_TINT, TRAP_TINT):
            scene.add(donut, np.zeros((count, 3)), environment=environments, tint=tint)
        focal = 0.5 * config.size  # gives a field of view of 90 degrees
        middle = 0.5 * config.size
        super().__init__(
            scene,
            count,
            gymnasium.spaces.Discrete(3),
            K=[[focal, 0, middle], [0, focal, middle], [0, 0, 1]],
            width=config.size,
            height=config.size,
            max_steps=config.max_steps,
            background=SKY,
            device=config.device,
        )
        self._positions = torch.zeros(count, 2, device=self.device)
        self._headings = torch.zeros(count, device=self.device)
        # first the goals, then the traps
        self._donuts = torch.zeros(2, count, 3, device=self.device)

    def _uniform(self, low: float, high: float) -> torch.Tensor:
        numbers = torch.rand(self.num_envs, generator=self.random, device=self.device)
        return low + (high - low) * numbers

    def start_worlds(self, is_new: torch.Tensor) -> None:
        direction = self._uniform(-1.0, 1.0)
        side = torch.where(self._uniform(0, 1) < 0.5, -1.0, 1.0)
        trap_direction = direction + side * self._uniform(0.6, 1.4)
        donuts = torch.stack([self._points(direction), self._points(trap_direction)])
        self._donuts = torch.where(is_new[:, None], donuts, self._donuts)
        self._positions = torch.where(is_new[:, None], 0.0, self._positions)
        self._headings = torch.where(is_new, 0.0, self._headings)
        self.scene.move(positions=self._donuts.reshape(-1, 3))
        self._write_cameras()

    def _points(self, directions: torch.Tensor) -> torch.Tensor:
        """Return points on the ground (N, 3), at random distances."""
        distance = self._uniform(2.5, 4.0)
        x = distance * torch.cos(directions)
        y = distance * torch.sin(directions)
        return torch.stack([x, y, torch.full_like(x, 0.3)], dim=1)

    def step_worlds(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        before = self._distances()
        self._headings = self._headings + TURN * (1 - actions).to(torch.float32)
        stride = STRIDE * torch.stack([self._headings.cos(), self._headings.sin()], dim=1)
        self._positions = self._positions + stride
        after = self._distances()
        has_goal = after[0] < REACH
        has_trap = (after[1] < REACH) & ~has_goal
        rewards = before[0] - after[0] + 2.0 * has_goal - 2.0 * has_trap
        return rewards, has_goal | has_trap

    def _distances(self) -> torch.Tensor:
        """Return the distances to goals and traps (2, N)."""
        return torch.linalg.vector_norm(self._donuts[:, :, :2] - self._positions, dim=-1)

    def _write_cameras(self) -> None:
        cosine = self._headings.cos()
        sine = self._headings.sin()
        zero = torch.zeros_like(sine)
        x, y = self._positions.unbind(dim=1)
        self.viewmats[:, 0] = torch.stack([sine, -cosine, zero, cosine * y - sine * x], dim=1)
        self.viewmats[:, 1] = torch.stack([zero, zero, zero - 1, zero + EYE_HEIGHT], dim=1)
        self.viewmats[:, 2] = torch.stack([cosine, sine, zero, -cosine * x - sine * y], dim=1)


class Policy(nn.Module):
    """A network that computes logits of actions and the value of a state from a
    picture."""

    def __init__(self, num_actions: int, size: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * math.ceil(size / 8) ** 2, 128),
            nn.ReLU(),
        )
        self.logits = nn.Linear(128, num_actions)
        self.value = nn.Linear(128, 1)
        nn.init.zeros_(self.logits.weight)

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.body(pictures.permute(0, 3, 1, 2).float() / 255 - 0.5)
        return self.logits(features), self.value(features)[:, 0]


class Rollout(NamedTuple):
    """T steps of N environments: pictures (T, N, H, W, 3), other arrays (T, N)."""

    pictures: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor
    is_used: torch.Tensor  # False where an action was ignored because an episode began


@torch.no_grad()
def collect(
    env: DriveToDonut, policy: Policy, state: tuple[torch.Tensor, torch.Tensor], steps: int
) -> tuple[Rollout, tuple[torch.Tensor, torch.Tensor]]:
    """Take steps with the policy, and estimate advantages (GAE, Schulman et al.
    2016)."""
    pictures, has_ended = state
    rows = []
    for _ in range(steps):
        logits, values = policy(pictures)
        actions = torch.multinomial(logits.softmax(dim=-1), 1)[:, 0]
        log_probs = logits.log_softmax(dim=-1).gather(1, actions[:, None])[:, 0]
        following, rewards, terminations, truncations, _ = env.step(actions)
        rows.append((pictures, actions, log_probs, values, rewards, terminations, ~has_ended))
        pictures = following
        has_ended = terminations | truncations
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    _, next_values = policy(pictures)
    advantages = advantages_of(columns[3], columns[4], columns[5], columns[6], next_values)
    rollout = Rollout(
        pictures=columns[0],
        actions=columns[1],
        log_probs=columns[2],
        advantages=advantages,
        returns=advantages + columns[3],
        is_used=columns[6],
    )
    return rollout, (pictures, has_ended)


def advantages_of(
    values: torch.Tensor,
    rewards: torch.Tensor,
    terminations: torch.Tensor,
    is_used: torch.Tensor,
    next_values: torch.Tensor,
    discount: float = 0.97,
    trace: float = 0.95,
) -> torch.Tensor:
    """Return advantages (T, N).

    A step that only starts an episode passes no advantage to the step before it.
    """
    advantages = torch.zeros_like(values)
    later = torch.zeros_like(next_values)
    for step in reversed(range(len(values))):
        goes_on = (~terminations[step]).float()
        difference = rewards[step] + discount * goes_on * next_values - values[step]
        later = (difference + discount * trace * goes_on * later) * is_used[step]
        advantages[step] = later
        next_values = values[step]
    return advantages


def improve(policy: Policy, optimizer: torch.optim.Optimizer, rollout: Rollout) -> None:
    """Update the policy by four epochs of PPO (Schulman et al. 2017)."""
    flat = Rollout(*(array.flatten(0, 1)[rollout.is_used.flatten()] for array in rollout))
    num_parts = max(4, len(flat.actions) // 4096)
    for _ in range(4):
        order = torch.randperm(len(flat.actions), device=flat.actions.device)
        for part in order.chunk(num_parts):
            loss = loss_of(policy, Rollout(*(array[part] for array in flat)))
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()


def loss_of(policy: Policy, batch: Rollout) -> torch.Tensor:
    logits, values = policy(batch.pictures)
    log_all = logits.log_softmax(dim=-1)
    log_probs = log_all.gather(1, batch.actions[:, None])[:, 0]
    ratio = (log_probs - batch.log_probs).exp()
    advantages = batch.advantages - batch.advantages.mean()
    advantages = advantages / (advantages.std() + 1e-6)
    gain = torch.minimum(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
    entropy = -(log_all.exp() * log_all).sum(dim=-1).mean()
    return -gain + 0.5 * (values - batch.returns).square().mean() - 0.01 * entropy


@torch.no_grad()
def mean_return(
    env: DriveToDonut, act: Callable[[torch.Tensor], torch.Tensor], seed: int, max_steps: int
) -> float:
    """Return the mean return of the first episode of every environment."""
    pictures, _ = env.reset(seed=seed)
    total = torch.zeros(env.num_envs, device=env.device)
    is_running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    for _ in range(max_steps):
        pictures, rewards, terminations, truncations, _ = env.step(act(pictures))
        total += rewards * is_running
        is_running &= ~(terminations | truncations)
    return float(total.mean())


@torch.no_grad()
def film(env: DriveToDonut, policy: Policy, seed: int) -> torch.Tensor:
    """Return the pictures that the first robot sees until its episode ends, side by
    side."""
    pictures, _ = env.reset(seed=seed)
    strip = []
    for _ in range(12):
        strip.append(pictures[0])
        pictures, _, terminations, truncations, _ = env.step(policy(pictures)[0].argmax(dim=-1))
        if (terminations | truncations)[0]:
            break
    return torch.cat(strip, dim=1)


def main(config: Config) -> tuple[float, float]:
    """Train a policy; return the mean returns of random actions and of the policy."""
    torch.manual_seed(config.seed)
    build = v3dg.BuildConfig(steps=0)
    donut = v3dg.build_bundle(make_donut(config.gaussians), config=build, progress=False)
    env = DriveToDonut(donut, config)
    policy = Policy(3, config.size).to(env.device)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    test_seed = 1_000_003 + config.seed

    def act_at_random(pictures: torch.Tensor) -> torch.Tensor:
        return torch.randint(0, 3, (len(pictures),), device=pictures.device)

    def act(pictures: torch.Tensor) -> torch.Tensor:
        return policy(pictures)[0].argmax(dim=-1)

    at_random = mean_return(env, act_at_random, test_seed, config.max_steps)
    print(f"random actions: return {at_random:.2f}")
    pictures, _ = env.reset(seed=config.seed)
    state = (pictures, torch.zeros(config.envs, dtype=torch.bool, device=env.device))
    for update in range(config.updates):
        rollout, state = collect(env, policy, state, config.steps)
        improve(policy, optimizer, rollout)
        if (update + 1) % 10 == 0:
            reward = float(rollout.returns[rollout.is_used].mean())
            print(f"update {update + 1}: discounted return {reward:.2f}")
    learned = mean_return(env, act, test_seed, config.max_steps)
    print(f"policy: return {learned:.2f}")
    if config.output is not None:
        write_picture(config.output, film(env, policy, test_seed).cpu().numpy() / 255)
    return at_random, learned


if __name__ == "__main__":
    main(tyro.cli(Config))
