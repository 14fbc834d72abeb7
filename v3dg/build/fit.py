"""The core's fit: its settings, and running it so that Ctrl-C and whoever shows progress stay alive."""

from __future__ import annotations

import _thread
import threading
import time
import weakref
from collections.abc import Callable
from typing import TypeVar

from v3dg import _core, _device
from v3dg._device import Device
from v3dg.build.config import BuildConfig

_T = TypeVar("_T")


def fit_config(config: BuildConfig, seed: int, level: int) -> _core.FitConfig:
    """The settings of the core's fit, all of which it asks for."""
    return _core.FitConfig(
        steps=config.steps,
        views_per_step=config.views_per_step,
        num_views=config.num_views,
        supersample=config.supersample,
        image_size=config.image_size,
        px2_per_gaussian=config.px2_per_gaussian,
        distance=config.distance,
        filter_px2=config.filter_px2,
        antialiased=True,
        loss_l1=config.loss_l1,
        loss_dssim=config.loss_dssim,
        loss_alpha=config.loss_alpha,
        step_position=config.step_position,
        step_log_scale=config.step_log_scale,
        step_quat=config.step_quat,
        step_logit=config.step_logit,
        step_sh0=config.step_sh0,
        step_sh_rest=config.step_sh_rest,
        position_in_world=config.position_in_world,
        final_step=config.final_step,
        seed=seed * 64 + level,  # every level has views of its own
    )


def run_fit(
    fit: Callable[[_core.FitProgress], _T], where: Device, show: Callable[[_core.FitProgress], None]
) -> _T:
    """Run `fit` on a thread of its own, and `show` how far it is while it computes; what it returns."""
    state = _core.FitProgress()
    result: list[_T] = []

    def collect(progress: _core.FitProgress) -> None:
        result.append(fit(progress))

    fit_there = _device.with_this_stream(collect, where)
    failure: list[BaseException] = []
    done = threading.Event()

    def work(token: _Token) -> None:
        del token  # the thread itself still has it
        try:
            fit_there(state)
        except BaseException as error:
            failure.append(error)
        finally:
            done.set()

    # Not threading.Thread: its start waits for ever for a thread that ends, for want of memory, before its
    # first line; and Ctrl-C during its join can make Python 3.11 take it for finished while it runs.
    tokens = [_Token()]
    runs = weakref.ref(tokens[0])
    try:
        _thread.start_new_thread(work, (tokens.pop(),))
        while runs() is not None and not done.wait(0.1):
            show(state)
    except BaseException:
        state.cancel()
        while runs() is not None and not done.is_set():
            time.sleep(0.01)
        raise
    if failure:
        raise failure[0]
    if not done.is_set():
        raise MemoryError("a thread that had started ended at once")
    show(state)
    return result[0]


class _Token:
    """Goes when whoever holds it does."""
