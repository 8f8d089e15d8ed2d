"""The memory, address space and processors that this process may use."""

import ctypes
import math
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

from ngpt.errors import WrongUse

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

# MiB of address space that stand for "no limit"
UNLIMITED = 2**40

# The largest number of threads of a pool, set by ``limit_threads``; None without a limit
_most: int | None = None

# Bytes of memory to assume if the system does not tell
_ASSUMED = 2**34

# The folder where Linux shows the control groups of containers, and the file that lists those of this process
_GROUPS, _OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def processors() -> int:
    """The number of threads for NumPy, SciPy, ONNX Runtime, OIDN and OpenEXR.

    It is the number of processors that this process may run on. The time quota of a container and ``limit_threads``
    lower it.
    """
    own = _visible()
    return min(own, _most or own, _quota() or own)


def _visible() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _quota() -> int | None:
    """The number of processors, rounded up, whose time the control groups allow; None without a limit."""
    found = [(quota, period) for quota, period in map(str.split, _of_groups("cpu.max", ""))]  # microseconds, or "max"
    found += zip(_of_groups("cpu.cfs_quota_us", "cpu"), _of_groups("cpu.cfs_period_us", "cpu"), strict=False)
    limits = [int(quota) / int(period) for quota, period in found if quota.isdecimal()]
    return max(1, math.ceil(min(limits))) if limits else None


def _of_groups(name: str, controller: str) -> list[str]:
    """The contents of the files ``name`` in the control group of this process and in all groups above it.

    ``controller``  a controller of cgroup version 1, which has a tree of groups for each controller; "" for version 2
    """
    try:
        lines = [line.split(":", 2) for line in _OWN_GROUPS.read_text(encoding="utf-8", errors="replace").splitlines()]
    except OSError:  # not Linux
        return []
    own = next((path for _, names, path in lines if controller in names.split(",")), None)
    if own is None:
        return []
    root = _GROUPS / controller
    # In a container, the path may be that of the host, which the container lacks. Then only the root exists.
    folders = [root / own.strip("/"), *(root / own.strip("/")).parents]
    files = [folder / name for folder in folders if folder == root or root in folder.parents]
    return [file.read_text(encoding="ascii").strip() for file in files if file.is_file()]


def limit_threads(most: int) -> None:
    """Limits the number of threads that ngpt uses from now on. A later call replaces the limit.

    PyTorch, renderers and BLAS have limits of their own; no reconstruction needs BLAS. Raises WrongUse unless ``most``
    is a whole number of at least 1.
    """
    global _most
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise WrongUse(f"threads: {most!r} is not allowed; give a whole number, 1 or more")
    _most = most


def limited() -> bool:
    """Whether ``processors()`` is less than the number of threads that libraries would choose themselves."""
    return _most is not None or processors() < _visible()


def memory() -> int:
    """Bytes that this process may use: the least of the machine's memory, the container's limit and its own limit."""
    texts = _of_groups("memory.max", "") + _of_groups("memory.limit_in_bytes", "memory")
    limits = [int(text) for text in texts if text.isdecimal()]
    own = address_space()
    return min([_physical(), *limits, *([] if own is None else [own])])


def _physical() -> int:
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    kibibytes = ctypes.c_ulonglong()
    with suppress(AttributeError):  # neither POSIX nor Windows
        # This call sets nothing on virtual machines without the firmware tables of a real machine.
        ctypes.windll.kernel32.GetPhysicallyInstalledSystemMemory(ctypes.byref(kibibytes))  # type: ignore[attr-defined]
    return kibibytes.value * 1024 or _ASSUMED


def address_space() -> int | None:
    """Bytes that this process may map (``ulimit -v``); None without a limit."""
    if resource is None:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def free_address_space() -> int:
    """MiB that this process may still map; ``UNLIMITED`` without a limit."""
    limit = address_space()
    if limit is None:
        return UNLIMITED
    try:
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        used = 0
    return max(0, limit - used) // 2**20


def limit_address_space(limit: int) -> None:
    """Limits the bytes that this process may map, if the system can, and turns core dumps off."""
    if resource is None:
        return
    own = resource.getrlimit(resource.RLIMIT_AS)[1]
    most = limit if own == resource.RLIM_INFINITY else min(limit, own)
    with suppress(ValueError, OSError):  # macOS has this limit but refuses to set it
        resource.setrlimit(resource.RLIMIT_AS, (most, own))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
