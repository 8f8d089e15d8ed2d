"""The commands that install missing packages, as messages show them."""

import re
import shlex
import shutil
import sys
from pathlib import Path

# Whether the package index has ngpt-recon. The first release sets this to True, and then the table in README must name
# the index, which a test checks.
PUBLISHED = False

NAME, STUDIES = "ngpt-recon", "ngpt-studies"
# The entries that ngpt-studies adds to registries. Keys are the words of registries for an entry, such as "sampler".
_PHOTONS = ("beams", "gbeams", "gbre", "gplanes", "gpm", "gvcm", "gvpm", "planes", "vpm")
_SAMPLERS = ("gbdpt", "gmlt", "gpt-tiles", "restir", "split", *_PHOTONS)
BROUGHT = {"method": ("nlm",), "network": ("kpcn",), "sampler": _SAMPLERS}
CHECKOUT = Path(__file__).parents[2]


def install_command(extra: str) -> str:
    """The command that installs an ``extra`` of ngpt-recon, from the index or this checkout, or else its packages."""
    if PUBLISHED:
        return f"{_pip()} install '{NAME}[{extra}]'"
    if (CHECKOUT / "pyproject.toml").is_file():
        return f"{_pip()} install -e {shlex.quote(f'{CHECKOUT}[{extra}]')}"
    # The packages are named one by one, because the file of the installed wheel may be gone by now.
    return f"{_pip()} install {shlex.join(packages_of(extra))}"


def package_command(package: str) -> str:
    """The command that installs a package from the index."""
    return f"{_pip()} install {shlex.quote(package)}"


def study(what: str, name: str) -> str:
    """The message for a method, sampler or network of ngpt-studies, which is not installed; "" for other names."""
    if name not in BROUGHT.get(what, ()):
        return ""
    folder = CHECKOUT / "studies"
    if PUBLISHED:
        how = f"`{package_command(STUDIES)}`"
    elif folder.is_dir():
        how = f"`{_pip()} install -e {shlex.quote(str(folder))}`"
    else:
        how = f"in a checkout of ngpt, `{_pip()} install -e studies`"
    return f"{what} '{name}' is of the package {STUDIES}, which is not installed; {how}"


def packages_of(extra: str) -> list[str]:
    """The packages of an extra with their required versions, from the metadata of the installed ngpt-recon."""
    from importlib.metadata import PackageNotFoundError, requires  # takes 50 ms

    try:
        lines = requires(NAME) or []
    except PackageNotFoundError:
        return [f"{NAME}[{extra}]"]
    return [line.partition(";")[0].strip() for line in lines if re.search(rf"extra == ['\"]{extra}['\"]", line)]


def _pip() -> str:
    """The command of this Python's pip, which may not be the pip that the shell finds."""
    found = shutil.which("pip")
    beside = found is not None and Path(found).parent == Path(sys.executable).parent
    return "pip" if beside else f"{shlex.quote(sys.executable)} -m pip"
