"""Finds the LLVM library that Dr.Jit's CPU backend needs, and explains what to do when there is none.

Dr.Jit loads libLLVM at run time. Versions below 16 abort the whole process inside the first kernel ("Cannot select
fminimum"). Dr.Jit takes whichever library the linker offers first. So this module chooses a library before Dr.Jit loads
one.
"""

import ctypes
import glob
import os
import re
import sys
from pathlib import Path

from ngpt.errors import NgptError

MINIMUM_VERSION = 16
ENVIRONMENT = "DRJIT_LIBLLVM_PATH"

_PATTERNS = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)


def find_llvm() -> dict[Path, int]:
    """All LLVM libraries in the usual places, links resolved: path -> major version, newest first."""
    paths = (Path(name).resolve() for pattern in _PATTERNS for name in glob.glob(pattern))
    found = {path: version for path in paths if (version := llvm_version(path)) is not None}
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def llvm_version(path: Path) -> int | None:
    """The major version in the name of a library ("libLLVM.so.19.1", "libLLVM-14.0.6.so.1") or of its folder, or
    None."""
    match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", path.name) or re.search(r"llvm[-@]?(\d+)", str(path.parent))
    return int(match.group(1)) if match else None


def use_llvm() -> Path:
    """Points Dr.Jit to the newest usable LLVM library and returns its path.

    A library the user has named in DRJIT_LIBLLVM_PATH is used as it is, after a check of its version. Raises NgptError
    if there is no usable library.
    """
    chosen = os.environ.get(ENVIRONMENT)
    if chosen:
        path = Path(chosen)
        if not path.is_file():
            raise NgptError(f"{ENVIRONMENT}={chosen}: no such file; unset it, or name a libLLVM of version >= 16")
        version = llvm_version(path.resolve())
        if version is None:
            version = MINIMUM_VERSION if _has_modern_interface(path) else 0
        if version < MINIMUM_VERSION:
            raise NgptError(
                f"{ENVIRONMENT}={chosen}: is older than LLVM {MINIMUM_VERSION}, with which Dr.Jit aborts; {_remedy()}"
            )
        return path
    found = find_llvm()
    usable = [path for path, version in found.items() if version >= MINIMUM_VERSION]
    if not usable:
        seen = f"only versions {sorted(set(found.values()))} found" if found else "none found"
        raise NgptError(
            f"rendering on the CPU needs the LLVM library, version {MINIMUM_VERSION} or newer ({seen}); {_remedy()}"
        )
    os.environ[ENVIRONMENT] = str(usable[0])
    return usable[0]


def _has_modern_interface(path: Path) -> bool:
    """Whether the library has LLVMGetVersion, which came with LLVM 16."""
    try:
        return hasattr(ctypes.CDLL(str(path)), "LLVMGetVersion")
    except OSError:
        return False


def _remedy() -> str:
    install = "`brew install llvm`" if sys.platform == "darwin" else "`apt-get install libllvm19` (as root)"
    return f"install one, e.g. {install}, or set {ENVIRONMENT} to its file"


if __name__ == "__main__":
    # For scripts that prepare a machine: prints the library on success. On failure prints one line of advice, with
    # status 1.
    try:
        print(use_llvm())
    except NgptError as error:
        sys.exit(str(error))
