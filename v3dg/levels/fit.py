"""Runs the fits of the core with the right settings. Meanwhile, Ctrl-C and the progress
display keep working."""

import _thread
import threading
import time
import weakref
from collections.abc import Callable
from typing import TypeVar

from v3dg import _core, _device
from v3dg._device import Device
from v3dg.levels.config import BuildConfig

_T = TypeVar("_T")


def fit_config(config: BuildConfig, seed: int, level: int) -> _core.FitConfig:
    """Return the settings of the core's fit for the groups of a level."""
    return _core.FitConfig(
        steps=config.steps_at(level),
        views_per_step=config.views_per_step,
        num_views=config.num_views,
        supersample=config.samples_at(level),
        image_size=config.image_size,
        px2_per_gaussian=config.px2_per_gaussian,
        distance=config.distance,
        filter_px2=config.filter_px2,
        antialiased=True,
        loss_l1=config.loss_l1,
        loss_dssim=config.loss_dssim,
        loss_alpha=config.loss_alpha,
        loss_cells=config.loss_cells,
        step_position=config.step_position,
        step_log_scale=config.step_log_scale,
        step_quat=config.step_quat,
        step_logit=config.step_logit,
        step_sh0=config.step_sh0,
        step_sh_rest=config.step_sh_rest,
        position_in_world=config.position_in_world,
        final_step=config.final_step,
        beta2=config.beta2,
        seed=seed,
    )


def run_fit(
    fit: Callable[[_core.FitProgress], _T],
    device: Device,
    show: Callable[[_core.FitProgress], None],
) -> _T:
    """Run `fit` on a separate thread, call `show` with its progress meanwhile, and
    return its result."""
    state = _core.FitProgress()
    result: list[_T] = []
    run = _device.with_this_stream(lambda: result.append(fit(state)), device)
    failure: list[BaseException] = []
    has_ended = threading.Event()

    def work(token: _Token) -> None:
        # The running thread keeps its arguments alive until it ends, so this is not the
        # last reference.
        del token
        try:
            run()
        except BaseException as error:
            failure.append(error)
        finally:
            has_ended.set()

    # threading.Thread has two faults here. If the thread ends before its first line for
    # lack of memory, start() waits forever. After Ctrl-C during join(), Python 3.11 may
    # treat a running thread as finished.
    tokens = [_Token()]
    running_token = weakref.ref(tokens[0])
    try:
        _thread.start_new_thread(work, (tokens.pop(),))
        while running_token() is not None and not has_ended.wait(0.1):
            show(state)
    except BaseException:
        state.cancel()
        while running_token() is not None and not has_ended.is_set():
            time.sleep(0.01)
        raise
    if failure:
        raise failure[0]
    if not has_ended.is_set():
        raise MemoryError(
            "thread: ended at once because memory is short; free some memory and try again"
        )
    show(state)
    return result[0]


class _Token:
    """An object that lives as long as the thread that holds it."""
