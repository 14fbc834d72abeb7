"""The start of a process that runs a command: it opens closed streams, and handles
Ctrl-C.

Ctrl-C, once or repeatedly, ends the process with one line. The package imports this
module before everything that takes long, so the module itself imports almost nothing.
Before a command runs there is nothing to clean up, and Ctrl-C ends the process at once;
from then on it raises KeyboardInterrupt.
"""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found] # all but enumerations of its names
import importlib
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    import types
    import weakref

_AGAIN_AFTER_S = 0.02

SIGNALS = (signal.SIGINT, signal.SIGALRM)
"""The signals of Ctrl-C. The second one repeats an interrupt that could not be handled,
for example during an import."""


def refuse_sub_interpreter() -> None:
    """Raise ImportError in an interpreter that is not the main one of its process.

    The compiled module and NumPy support only one interpreter; in others, loading them
    would wait forever.
    """
    for name in ("_interpreters", "_xxsubinterpreters"):  # since Python 3.13, and before
        try:
            interpreters = importlib.import_module(name)
        except ImportError:
            continue
        if interpreters.get_current() != interpreters.get_main():
            raise ImportError(
                "v3dg: expected the main interpreter of a process, got a sub-interpreter; use a "
                "process"
            )
        return


def begin() -> None:
    """Open closed streams on the null device, and make Ctrl-C end the process."""
    # This is skipped if the parent process ignores Ctrl-C.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass  # otherwise a file would get the number of a stream, and everything that is printed
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        # Characters that an encoding lacks are escaped.
        getattr(sys, name).reconfigure(errors="backslashreplace")


def _end_at_once(number: int, frame: types.FrameType | None) -> None:
    signal.signal(signal.SIGINT, lambda *_: None)  # further interrupts must not print a second line
    try:
        os.write(2, b"v3dg: error: interrupted\n")
    finally:
        os._exit(130)


def raise_interrupts() -> None:
    """Make Ctrl-C raise KeyboardInterrupt from now on, if it ended the process at once
    so far."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        interrupts = _Interrupts()
        for number in reversed(SIGNALS):
            signal.signal(number, interrupts.handle)
        sys.unraisablehook = interrupts.unraisable


class _Interrupt(KeyboardInterrupt):
    """A KeyboardInterrupt that supports weak references."""


class _Interrupts:
    """Raises one interrupt, and no other while it propagates, so that cleaning up is
    not interrupted."""

    def __init__(self) -> None:
        import weakref

        self._refer = weakref.ref
        self._raised: weakref.ref[_Interrupt] | None = None

    def handle(self, number: int, frame: types.FrameType | None) -> None:
        # The interrupt is postponed during an import, which would leave an incomplete
        # module, and while this thread blocks Ctrl-C, if another thread has received
        # it.
        if _is_importing(frame) or signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)
        elif self._raised is None or self._raised() is None:
            raise self._interrupt()

    def _interrupt(self) -> _Interrupt:
        # The exception is not created in `handle`: it would refer to a frame that
        # refers to it, and stay alive.
        interrupt = _Interrupt()
        self._raised = self._refer(interrupt)
        return interrupt

    def unraisable(self, arguments: sys.UnraisableHookArgs) -> None:
        """Raise an interrupt again that a destructor or a callback has swallowed."""
        if isinstance(arguments.exc_value, _Interrupt):
            self._raised = None
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)
        else:
            sys.__unraisablehook__(arguments)


def _is_importing(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


refuse_sub_interpreter()
# The program's name precedes the arguments; an interactive process has none.
if [os.path.basename(name) for name in sys.orig_argv[-len(sys.argv) :][:1]] in (
    ["v3dg"],
    ["-mv3dg"],
):
    begin()
