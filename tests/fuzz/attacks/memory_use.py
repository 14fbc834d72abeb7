"""Measures the peak memory of a piece of work, and limits it so that no try takes all
memory of the machine."""

import ctypes
import resource


class Watch:
    """Measures memory from the creation of this object on."""

    def __init__(self):
        # otherwise memory that was freed before would hide later allocations
        ctypes.CDLL(None).malloc_trim(0)
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
        self._before = _status("VmRSS")

    def megabytes(self):
        """Return the peak memory in MB beyond the memory at the start."""
        return (_status("VmHWM") - self._before) / 1e6


def limit_growth(num_bytes):
    """Let this process allocate at most this much more memory; more is a
    MemoryError."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + num_bytes, hard))


def _status(name):
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith(f"{name}:"))
    return int(line.split()[1]) << 10
