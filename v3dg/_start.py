"""Prepares a process that runs a command: reopens closed standard streams, and handles
Ctrl-C.

Ctrl-C, once or repeatedly, ends the process with one line of text. The package imports
this module before modules that take long to import, so this module itself imports
almost nothing. Until a command runs, nothing needs to be cleaned up, so Ctrl-C ends the
process immediately. While a command runs, Ctrl-C raises KeyboardInterrupt.
"""

from __future__ import annotations

# This is the module `signal` without its enumerations, which take long to import.
import _signal as signal  # type: ignore[import-not-found]
import importlib
import os
import sys

from v3dg import _system

TYPE_CHECKING = False
if TYPE_CHECKING:
    import types
    import weakref


def refuse_sub_interpreter() -> None:
    """Raise ImportError in a sub-interpreter.

    The compiled module and NumPy only support the main interpreter of a process.
    Importing them in another one would wait forever.
    """
    # The name of the module since Python 3.13, and its earlier name.
    for name in ("_interpreters", "_xxsubinterpreters"):
        try:
            interpreters = importlib.import_module(name)
        except ImportError:
            continue
        if interpreters.get_current() != interpreters.get_main():
            raise ImportError(
                "v3dg: expected the main interpreter of a process, got a sub-interpreter; use a "
                "separate process"
            )
        return


def begin() -> None:
    """Open closed standard streams on the null device, and make Ctrl-C end the
    process."""
    # If the parent process ignores Ctrl-C, this process ignores it, too.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
    _system.unblock_signals({signal.SIGINT})
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        # Opening the null device fills the closed descriptors 0 to 2. Otherwise, a file
        # that is opened later could get one of them, and output would be written to
        # that file.
        pass
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        # Characters that the encoding does not have are printed as escapes.
        getattr(sys, name).reconfigure(errors="backslashreplace")


def _end_at_once(number: int, frame: types.FrameType | None) -> None:
    # Further interrupts must not print a second line.
    signal.signal(signal.SIGINT, lambda *_: None)
    try:
        os.write(2, b"v3dg: error: interrupted\n")
    finally:
        os._exit(130)


def raise_interrupts() -> None:
    """If Ctrl-C ends the process immediately so far, make it raise KeyboardInterrupt
    from now on."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        interrupts = _Interrupts()
        for number in reversed(_system.SIGNALS):
            signal.signal(number, interrupts.handle)
        sys.unraisablehook = interrupts.unraisable


class _Interrupt(KeyboardInterrupt):
    """A KeyboardInterrupt that supports weak references."""


class _Interrupts:
    """Raises at most one interrupt at a time, so that a second Ctrl-C does not
    interrupt the clean-up after the first one."""

    def __init__(self) -> None:
        import weakref

        self._refer = weakref.ref
        self._raised: weakref.ref[_Interrupt] | None = None

    def handle(self, number: int, frame: types.FrameType | None) -> None:
        # The interrupt is postponed in two cases: during an import, which would leave
        # an incomplete module, and while this thread blocks Ctrl-C but another thread
        # has received the signal.
        if _is_importing(frame) or signal.SIGINT in _system.block_signals(()):
            _system.interrupt_soon()
        elif self._raised is None or self._raised() is None:
            raise self._interrupt()

    def _interrupt(self) -> _Interrupt:
        # The exception is created here instead of in `handle`. Otherwise, it and the
        # frame of `handle` would refer to each other and stay alive.
        interrupt = _Interrupt()
        self._raised = self._refer(interrupt)
        return interrupt

    def unraisable(self, arguments: sys.UnraisableHookArgs) -> None:
        """Schedule an interrupt again if a destructor or a callback swallowed it."""
        if isinstance(arguments.exc_value, _Interrupt):
            self._raised = None
            _system.interrupt_soon()
        else:
            sys.__unraisablehook__(arguments)


def _is_importing(frame: types.FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


refuse_sub_interpreter()
# The name of the program comes before the arguments. An interactive process has no such
# name.
if [os.path.basename(name) for name in sys.orig_argv[-len(sys.argv) :][:1]] in (
    ["v3dg"],
    ["-mv3dg"],
):
    begin()
