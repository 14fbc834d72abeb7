"""How much memory a piece of work held, and a limit so that no try takes the
machine's."""

import ctypes
import resource


class Watch:
    """From when it is made."""

    def __init__(self):
        ctypes.CDLL(None).malloc_trim(0)  # what was freed would hide what is taken next
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
        self._before = _status("VmRSS")

    def megabytes(self):
        """The most that was held at once, beyond what was held at first."""
        return (_status("VmHWM") - self._before) / 1e6


def limit_growth(num_bytes):
    """Let this process take so much more than it has, so that more is a MemoryError."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + num_bytes, hard))


def _status(name):
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith(f"{name}:"))
    return int(line.split()[1]) << 10
