"""Code that depends on the operating system: signals, fork(), processors and memory.

Linux and macOS have all of POSIX that this package uses. Windows lacks the functions
that are looked up here. `_files` does the same for files.
"""

from __future__ import annotations

# This is the module `signal` without its enumerations, which take long to import.
import _signal as signal  # type: ignore[import-not-found]
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

AGAIN_AFTER_S = 0.02
"""Time until a postponed Ctrl-C is raised again."""

SIGNALS: tuple[int, ...] = (signal.SIGINT,)
"""The signals of Ctrl-C. SIGALRM repeats an interrupt that could not be handled, for
example during an import."""

_HAS_TIMER = hasattr(signal, "setitimer")
if _HAS_TIMER:
    SIGNALS = (signal.SIGINT, signal.SIGALRM)

_HAS_MASKS = hasattr(signal, "pthread_sigmask")


def block_signals(numbers: Iterable[int]) -> set[int]:
    """Block signals in this thread, and return those that were blocked before. On
    Windows, nothing is blocked."""
    if not _HAS_MASKS:
        return set()
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, numbers))


def unblock_signals(numbers: Iterable[int]) -> None:
    if _HAS_MASKS:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)


def set_blocked_signals(numbers: Iterable[int]) -> None:
    """Make these signals the only blocked ones of this thread."""
    if _HAS_MASKS:
        signal.pthread_sigmask(signal.SIG_SETMASK, numbers)


def interrupt_soon() -> None:
    """Raise an interrupt in the main thread after a moment."""
    if _HAS_TIMER:
        signal.setitimer(signal.ITIMER_REAL, AGAIN_AFTER_S)
        return
    import _thread
    import threading

    timer = threading.Timer(AGAIN_AFTER_S, _thread.interrupt_main)
    timer.daemon = True
    timer.start()


def _nothing() -> None:
    pass


def at_fork(
    prepare: Callable[[], object] = _nothing,
    in_parent: Callable[[], object] = _nothing,
    in_child: Callable[[], object] = _nothing,
) -> None:
    """Call these functions before every fork(), and after it in both processes. Does
    nothing on systems without fork()."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=prepare, after_in_parent=in_parent, after_in_child=in_child)


def num_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int:
    """Return the memory of the system, in bytes, that is free or can be freed
    immediately. If the system does not report it, return all of its memory."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) << 10
    except (OSError, ValueError, IndexError):
        pass
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    from v3dg import _windows

    return _windows.available_memory()


def resident_memory(statm_path: str = "/proc/self/statm") -> int:
    """Return the memory of this process in bytes. Without /proc, return the maximum so
    far."""
    try:
        with open(statm_path, encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        from v3dg import _windows

        return _windows.resident_memory()
    maximum = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, Linux KiB.
    if sys.platform == "darwin":
        return maximum
    return maximum << 10
