"""What makes a process a command: streams that are open, and Ctrl-C that ends it with one line, however often
it comes.

The package imports this before all that takes long, so it imports next to nothing itself. Until a command
runs, Ctrl-C has nothing to clean up and ends the process at once; from then on it raises KeyboardInterrupt.
"""

from __future__ import annotations

import _signal as signal  # type: ignore[import-not-found] # all but enumerations of its names
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    import types
    import weakref

_AGAIN_AFTER_S = 0.02

SIGNALS = (signal.SIGINT, signal.SIGALRM)
"""Of Ctrl-C: the second brings one again that could not be heard when it came, in the midst of an import."""


def refuse_sub_interpreter() -> None:
    """Raise an ImportError in an interpreter that is not the first of its process.

    The compiled module and NumPy know one interpreter alone; elsewhere, loading them waits without end.
    """
    for name in ("_interpreters", "_xxsubinterpreters"):  # since Python 3.13, and before
        try:
            interpreters = __import__(name)
        except ImportError:
            continue
        if interpreters.get_current() != interpreters.get_main():
            raise ImportError(
                "v3dg: expected the main interpreter of a process, got a sub-interpreter; use a process"
            )
        return


def begin() -> None:
    """Open streams that are closed, to nothing, and have Ctrl-C end the process."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started it ignores them
        signal.signal(signal.SIGINT, _end_at_once)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass  # else a file would get the number, and with it all that is printed
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        getattr(sys, name).reconfigure(errors="backslashreplace")  # what an encoding lacks


def _end_at_once(number: int, frame: types.FrameType | None) -> None:
    signal.signal(signal.SIGINT, lambda *_: None)  # another one has nothing to say
    try:
        os.write(2, b"v3dg: error: interrupted\n")
    finally:
        os._exit(130)


def raise_interrupts() -> None:
    """Have Ctrl-C raise KeyboardInterrupt from now on, where it has ended the process at once."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        interrupts = _Interrupts()
        for number in reversed(SIGNALS):
            signal.signal(number, interrupts.hear)
        sys.unraisablehook = interrupts.unraisable


class _Interrupt(KeyboardInterrupt):
    """Unlike its base, one that can be referred to weakly."""


class _Interrupts:
    """Raises one interrupt, and no other while that is on its way: whoever cleans up is not disturbed."""

    def __init__(self) -> None:
        import weakref

        self._refer = weakref.ref
        self._raised: weakref.ref[_Interrupt] | None = None

    def hear(self, number: int, frame: types.FrameType | None) -> None:
        # Later where half of a module would be left, and where another thread got what this one blocks.
        if _is_importing(frame) or signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)
        elif self._raised is None or self._raised() is None:
            raise self._interrupt()

    def _interrupt(self) -> _Interrupt:
        # Not in `hear`, where the exception would hold a frame that holds the exception, and never go.
        interrupt = _Interrupt()
        self._raised = self._refer(interrupt)
        return interrupt

    def unraisable(self, what: sys.UnraisableHookArgs) -> None:
        """Raise an interrupt again that a destructor or a callback has swallowed."""
        if isinstance(what.exc_value, _Interrupt):
            self._raised = None
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)
        else:
            sys.__unraisablehook__(what)


def _is_importing(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


refuse_sub_interpreter()
# What stands before the arguments, if anything does.
if [os.path.basename(name) for name in sys.orig_argv[-len(sys.argv) :][:1]] in (["v3dg"], ["-mv3dg"]):
    begin()
