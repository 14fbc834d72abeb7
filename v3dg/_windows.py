"""Functions of Windows that Python does not provide."""

import ctypes


class _MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load_percent", ctypes.c_uint32),
        ("total", ctypes.c_uint64),
        ("available", ctypes.c_uint64),
        ("total_with_page_file", ctypes.c_uint64),
        ("available_with_page_file", ctypes.c_uint64),
        ("total_addresses", ctypes.c_uint64),
        ("available_addresses", ctypes.c_uint64),
        ("available_extended", ctypes.c_uint64),
    )


class _ProcessMemory(ctypes.Structure):
    """PROCESS_MEMORY_COUNTERS."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("num_page_faults", ctypes.c_uint32),
        ("peak_resident", ctypes.c_size_t),
        ("resident", ctypes.c_size_t),
        ("peak_paged_pool", ctypes.c_size_t),
        ("paged_pool", ctypes.c_size_t),
        ("peak_other_pool", ctypes.c_size_t),
        ("other_pool", ctypes.c_size_t),
        ("page_file", ctypes.c_size_t),
        ("peak_page_file", ctypes.c_size_t),
    )


def available_memory() -> int:
    """Return the free memory of the system in bytes."""
    status = _MemoryStatus()
    status.length = ctypes.sizeof(status)
    if not _kernel().GlobalMemoryStatusEx(ctypes.byref(status)):
        raise OSError("memory: Windows does not report it; pass an amount of memory")
    return int(status.available)


def resident_memory() -> int:
    """Return the memory of this process in bytes, or 0 if Windows does not report
    it."""
    counters = _ProcessMemory()
    counters.length = ctypes.sizeof(counters)
    kernel = _kernel()
    kernel.GetCurrentProcess.restype = ctypes.c_void_p
    process = ctypes.c_void_p(kernel.GetCurrentProcess())
    kernel.K32GetProcessMemoryInfo(process, ctypes.byref(counters), counters.length)
    return int(counters.resident)


def _kernel() -> ctypes.CDLL:
    return ctypes.CDLL("kernel32")
