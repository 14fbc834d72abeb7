"""The core's fit: its settings, and running it so that Ctrl-C and whoever shows progress stay alive."""

import _thread
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import asdict
from typing import TypeVar

from v3dg import _core, _device
from v3dg._device import Device
from v3dg.build.config import BuildConfig

_T = TypeVar("_T")


# What of a config shapes the levels; all else is the fit's.
_OF_LEVELS = {
    *("cluster_size", "group_size", "min_clusters", "min_gaussians", "init", "prune_growth", "targets"),
    *("first_steps", "smooth", "asset_filter_px2", "asset_antialiased"),
}


def fit_config(config: BuildConfig, seed: int, level: int) -> _core.FitConfig:
    """The settings of the core's fit, which refuses one that it does not know or misses."""
    settings = {name: value for name, value in asdict(config).items() if name not in _OF_LEVELS}
    settings |= {"steps": config.steps_at(level), "supersample": config.samples_at(level)}
    return _core.FitConfig(**settings, antialiased=True, seed=seed)


def run_fit(
    fit: Callable[[_core.FitProgress], _T], where: Device, show: Callable[[_core.FitProgress], None]
) -> _T:
    """Run `fit` on a thread of its own, and `show` how far it is while it computes; what it returns."""
    state = _core.FitProgress()
    result: list[_T] = []
    fit_there = _device.with_this_stream(lambda: result.append(fit(state)), where)
    failure: list[BaseException] = []
    done = threading.Event()

    def work(token: _Token) -> None:
        del token  # the thread itself still has it
        try:
            fit_there()
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
