"""The choice of the LLVM library, without loading any."""

from pathlib import Path

import pytest

from data_gen import llvm
from ngpt.errors import NgptError


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch):
    # monkeypatch restores the variable afterwards, use_llvm() having set it or not.
    monkeypatch.setenv(llvm.ENVIRONMENT, "")
    monkeypatch.delenv(llvm.ENVIRONMENT)


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Makes empty files of these names the only libraries there are."""

    def install(*names):
        for name in names:
            (tmp_path / name).touch()
        monkeypatch.setattr(llvm, "_PATTERNS", (f"{tmp_path}/libLLVM*.so*",))

    return install


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-17.so.1", 17),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/llvm-16/lib/libLLVM.so", 16),
        ("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib", 18),
        ("/somewhere/libLLVM.so", None),
    ],
)
def test_version_from_the_name(name, version):
    assert llvm.llvm_version(Path(name)) == version


def test_takes_the_newest(machine):
    machine("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM-17.so.1")
    assert llvm.use_llvm().name == "libLLVM.so.19.1"
    assert llvm.os.environ[llvm.ENVIRONMENT].endswith("libLLVM.so.19.1")


def test_says_what_to_install_when_all_are_too_old(machine):
    machine("libLLVM-14.so.1", "libLLVM-15.so.1")
    with pytest.raises(NgptError, match=r"only versions \[14, 15\] found.*install libllvm19"):
        llvm.use_llvm()
    assert llvm.ENVIRONMENT not in llvm.os.environ


def test_says_what_to_install_when_there_is_none(machine):
    machine()
    with pytest.raises(NgptError, match=r"none found.*install libllvm19"):
        llvm.use_llvm()


def test_respects_the_users_choice_if_it_can_work(machine, tmp_path, monkeypatch):
    machine("libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.19.1")
    monkeypatch.setenv(llvm.ENVIRONMENT, str(tmp_path / "libLLVM-16.so.1"))
    assert llvm.use_llvm().name == "libLLVM-16.so.1"
    monkeypatch.setenv(llvm.ENVIRONMENT, str(tmp_path / "libLLVM-15.so.1"))
    with pytest.raises(NgptError, match="older than LLVM 16"):
        llvm.use_llvm()
    monkeypatch.setenv(llvm.ENVIRONMENT, str(tmp_path / "libLLVM-99.so"))
    with pytest.raises(NgptError, match="no such file"):
        llvm.use_llvm()
