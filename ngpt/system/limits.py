"""What this process may use: memory, address space, processors. Systems that set no such limit are asked for none."""

import ctypes
import os
from contextlib import suppress
from pathlib import Path

from ngpt.errors import WrongUse

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

# MiB of address space that stand for no limit: far more than any machine has.
UNLIMITED = 2**40

# The most threads of one pool that are allowed; None where nobody has set a limit.
_most: int | None = None

# Bytes of memory where the system does not say how much it has.
_ASSUMED = 2**34


def processors() -> int:
    """Processors that this process may run on, at most ``limit_threads``; the machine's where the system does not say.

    So many threads work at once: NumPy's, SciPy's, ONNX Runtime's, OIDN's and OpenEXR's.
    """
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(own, _most or own)


def limit_threads(most: int) -> None:
    """From now on work of this package takes at most so many threads. A later call replaces the limit of an earlier.

    PyTorch and renderers have limits of their own, and so has BLAS (OPENBLAS_NUM_THREADS and the like), which no
    reconstruction needs. Raises WrongUse unless ``most`` is a whole number of at least 1.
    """
    global _most
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise WrongUse(f"threads: {most!r} is not allowed; give a whole number, 1 or more")
    _most = most


def limited() -> bool:
    return _most is not None


def memory() -> int:
    """Bytes that this process may have: the machine's, or what its limits leave it."""
    physical, limit = _physical(), address_space()
    return physical if limit is None else min(physical, limit)


def _physical() -> int:
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    kibibytes = ctypes.c_ulonglong()
    with suppress(AttributeError):  # neither POSIX nor Windows
        # It returns False, and sets nothing, on virtual machines that lack the firmware tables of a real machine.
        ctypes.windll.kernel32.GetPhysicallyInstalledSystemMemory(ctypes.byref(kibibytes))  # type: ignore[attr-defined]
    return kibibytes.value * 1024 or _ASSUMED


def address_space() -> int | None:
    """Bytes that this process may map (``ulimit -v``), None where no limit is set."""
    if resource is None:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def free_address_space() -> int:
    """MiB that this process may still map, ``UNLIMITED`` where no limit is set."""
    limit = address_space()
    if limit is None:
        return UNLIMITED
    try:
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        used = 0
    return max(0, limit - used) // 2**20


def limit_address_space(limit: int) -> None:
    """Limits what this process may map to so many bytes, where the system can; its crashes write no memory to disk."""
    if resource is None:
        return
    own = resource.getrlimit(resource.RLIMIT_AS)[1]
    most = limit if own == resource.RLIM_INFINITY else min(limit, own)
    with suppress(ValueError, OSError):  # macOS knows this limit and refuses to set it
        resource.setrlimit(resource.RLIMIT_AS, (most, own))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
