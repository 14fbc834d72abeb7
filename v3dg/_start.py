"""The start of a process that is a command: opens closed streams, and handles Ctrl-C.

However often it comes, Ctrl-C ends the process with one line. The package imports this
module before everything that takes long, so it imports next to nothing itself. Until a
command runs, Ctrl-C has nothing to clean up and ends the process at once; from then on
it raises KeyboardInterrupt.
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
"""The signals of Ctrl-C; the second repeats one that could not be handled, as in the
midst of an import."""


def refuse_sub_interpreter() -> None:
    """Raise an ImportError in an interpreter that is not the first of its process.

    The compiled module and NumPy know one interpreter alone; elsewhere, loading them
    waits without end.
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
    """Open closed streams on the null device, and have Ctrl-C end the process."""
    # Not if the parent ignores Ctrl-C.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass  # otherwise a file would get the number of a stream, and everything that is printed
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        # Escapes characters that an encoding lacks.
        getattr(sys, name).reconfigure(errors="backslashreplace")


def _end_at_once(number: int, frame: types.FrameType | None) -> None:
    signal.signal(signal.SIGINT, lambda *_: None)  # another Ctrl-C must not print a second line
    try:
        os.write(2, b"v3dg: error: interrupted\n")
    finally:
        os._exit(130)


def raise_interrupts() -> None:
    """Have Ctrl-C raise KeyboardInterrupt from now on, if it ended the process at once
    until now."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        interrupts = _Interrupts()
        for number in reversed(SIGNALS):
            signal.signal(number, interrupts.handle)
        sys.unraisablehook = interrupts.unraisable


class _Interrupt(KeyboardInterrupt):
    """A KeyboardInterrupt that can be referred to weakly."""


class _Interrupts:
    """Raises one interrupt, and no other while that propagates, so that cleaning up is
    not disturbed."""

    def __init__(self) -> None:
        import weakref

        self._refer = weakref.ref
        self._raised: weakref.ref[_Interrupt] | None = None

    def handle(self, number: int, frame: types.FrameType | None) -> None:
        # Postponed during an import, which would leave half a module, and while this
        # thread blocks Ctrl-C, when another thread received it.
        if _is_importing(frame) or signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)
        elif self._raised is None or self._raised() is None:
            raise self._interrupt()

    def _interrupt(self) -> _Interrupt:
        # Not in `handle`: the exception would hold a frame that holds the exception,
        # and stay alive.
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
# The program's name, which precedes the arguments; there is none in an interactive
# process.
if [os.path.basename(name) for name in sys.orig_argv[-len(sys.argv) :][:1]] in (
    ["v3dg"],
    ["-mv3dg"],
):
    begin()
