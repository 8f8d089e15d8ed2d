"""The choice of the LLVM library, without loading any."""

from pathlib import Path

import pytest

from data_gen import llvm
from ngpt.errors import NgptError


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Makes empty files of these names the only libraries there are; the user may have chosen one."""

    def install(*names, chosen=""):
        for name in names:
            (tmp_path / f"libLLVM{name}").touch()
        monkeypatch.setattr(llvm, "_PATTERNS", (f"{tmp_path}/libLLVM*.so*",))
        monkeypatch.setenv(llvm.ENVIRONMENT, str(tmp_path / f"libLLVM{chosen}") if chosen else "")

    return install


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-17.so.1", 17),
        ("/usr/lib/llvm-16/lib/libLLVM.so", 16),
        ("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib", 18),
        ("/somewhere/libLLVM.so", None),
    ],
)
def test_version_from_the_name(name, version):
    assert llvm.llvm_version(Path(name)) == version


def test_the_newest_is_taken_or_the_users_choice(machine):
    machine("-14.so.1", ".so.19.1", "-17.so.1", "-16.so.1")
    assert llvm.use_llvm().name == "libLLVM.so.19.1"
    machine(chosen="-16.so.1")
    assert llvm.use_llvm().name == "libLLVM-16.so.1"
    assert llvm.os.environ[llvm.ENVIRONMENT].endswith("libLLVM-16.so.1")


@pytest.mark.parametrize(
    ("names", "chosen", "message"),
    [
        (["-14.so.1", "-15.so.1"], "", r"only versions \[14, 15\] found.*install libllvm19"),
        ([], "", r"none found.*install libllvm19"),
        (["-15.so.1", ".so.19.1"], "-15.so.1", "older than LLVM 16"),
        ([".so.19.1"], "-99.so", "no such file"),
    ],
)
def test_what_cannot_work_is_said_with_what_to_install(machine, names, chosen, message):
    machine(*names, chosen=chosen)
    with pytest.raises(NgptError, match=message):
        llvm.use_llvm()
    assert not llvm.os.environ[llvm.ENVIRONMENT] or chosen
