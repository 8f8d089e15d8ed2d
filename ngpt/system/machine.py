"""Describes the machine and the installed packages, for records of results."""

import platform
import subprocess
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from ngpt.system.limits import processors
from ngpt.version import __version__


def versions(*packages: str) -> dict[str, str | None]:
    """The versions of ngpt and of these packages; None for packages that are not installed."""
    return {"ngpt-recon": __version__, **{package: version(package) for package in packages}}


def version(package: str) -> str | None:
    try:
        return installed(package)
    except PackageNotFoundError:
        return None


def metadata(*packages: str) -> dict[str, Any]:
    """Versions of ngpt and of these packages, Python, machine, processor, threads, and the commit of the source."""
    return {
        "versions": versions(*packages),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu": _cpu(),
        "threads": processors(),
        "commit": _commit(),
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def _commit() -> str | None:
    """The commit of the source; None if it is not a checkout or git is not installed."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    except OSError:
        return None
    return found.stdout.strip() or None
