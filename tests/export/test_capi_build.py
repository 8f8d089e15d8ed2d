"""The C library as a package: its header, its symbols, find_package and pkg-config, the program of the docs."""

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
from capi import HEADER, SOURCE, command, tool

import ngpt

DOCS = SOURCE.parents[1] / "docs" / "embed" / "c-library.md"
STRICT = ["-Wall", "-Wextra", "-pedantic", "-Werror"]


def shown(language: str) -> str:
    """The program of the docs."""
    return re.search(rf"```{language}\n(.*?)```", DOCS.read_text(), re.S)[1]


PROJECT = """
cmake_minimum_required(VERSION 3.16)
project(renderer C CXX)
find_package(ngpt VERSION REQUIRED)
configure_file(renderer.c renderer.cpp COPYONLY)
add_executable(in-c renderer.c)
add_executable(in-cpp ${CMAKE_CURRENT_BINARY_DIR}/renderer.cpp)
foreach(program in-c in-cpp)
  target_compile_options(${program} PRIVATE -Wall -Wextra -pedantic -Werror)
  target_link_libraries(${program} PRIVATE ngpt::ngpt)
endforeach()
set_target_properties(in-c PROPERTIES C_STANDARD 90 C_EXTENSIONS OFF)
file(WRITE ${CMAKE_BINARY_DIR}/networks.txt ${ngpt_NETWORKS})
"""


C, CPP = ("gcc", "clang"), ("g++", "clang++")


@pytest.mark.hosts
@pytest.mark.parametrize(
    ("compilers", "standard"), [(C, "c89"), (C, "c99"), (C, "c17"), (CPP, "c++98")], ids=lambda value: value[:5]
)
def test_the_header_is_c_and_cpp(compilers, standard):
    language = "c++" if compilers == CPP else "c"
    command(tool(*compilers), f"-std={standard}", *STRICT, "-fsyntax-only", "-x", language, HEADER)


def test_only_functions_of_the_header_are_exported(prefix):
    listing = command(tool("nm"), "-D", "--defined-only", prefix / "lib" / "libngpt.so")
    declared = set(re.findall(r"\b(ngpt_\w+)\(", re.sub(r"/\*.*?\*/", "", HEADER.read_text(), flags=re.S)))
    assert {line.split()[-1].partition("@")[0] for line in listing.splitlines()} == declared
    assert len(declared) == 17


@pytest.fixture(scope="module")
def renderer_project(prefix, tmp_path_factory):
    """The build folder of a project that uses the package, with the program of the docs."""
    folder = tmp_path_factory.mktemp("renderer")
    (folder / "renderer.c").write_text(shown("c"))
    (folder / "CMakeLists.txt").write_text(PROJECT.replace("VERSION REQUIRED", f"{ngpt.__version__} REQUIRED"))
    command(tool("cmake"), "-S", folder, "-B", folder / "build", f"-DCMAKE_PREFIX_PATH={prefix}")
    command(tool("cmake"), "--build", folder / "build")
    return folder / "build"


@pytest.mark.parametrize("program", ["in-c", "in-cpp"])
def test_the_program_of_the_docs(renderer_project, program):
    network = (renderer_project / "networks.txt").read_text() + "/ngpt-fast.onnx"
    outcome = subprocess.run([renderer_project / program, network], capture_output=True, text=True, timeout=100)
    assert outcome.returncode == 0, outcome.stderr
    assert 0.7 < float(outcome.stdout) < 1.3
    assert outcome.stderr.startswith("reads primal, 3 channels, always\nreads direct, 3 channels, if there is one")
    assert outcome.stderr.endswith("\n  0 %\n100 %\n") and outcome.stderr.count("%") == 2


def test_pkg_config_tells_where_it_is(prefix, tmp_path):
    environment = os.environ | {"PKG_CONFIG_PATH": f"{prefix}/lib/pkgconfig"}
    words = [tool("pkg-config"), "--print-errors", "ngpt"]
    assert command(*words, "--modversion", env=environment).strip() == ngpt.__version__
    networks = command(*words, "--variable=networks", env=environment).strip()
    flags = command(*words, "--cflags", "--libs", env=environment).split()
    (tmp_path / "program.c").write_text(shown("c"))
    command(tool(*C), tmp_path / "program.c", *flags, "-o", tmp_path / "program")
    assert (Path(networks) / "ngpt-fast.onnx").is_file()


def configured(folder, *options) -> str:
    """What CMake says without ONNX Runtime of the system."""
    machine = f"{platform.machine()}-linux-gnu"
    of_system = [f"{at}/{folder}" for at in ("/usr", "/usr/local") for folder in ("include", "lib", f"lib/{machine}")]
    ignored = ";".join([*of_system, f"/lib/{machine}", "/lib", "/usr/include/onnxruntime"])
    words = [tool("cmake"), "-S", SOURCE, "-B", folder, f"-DCMAKE_IGNORE_PATH={ignored}", *options]
    outcome = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=100)
    return " ".join((outcome.stdout + outcome.stderr).split())


def test_cmake_tells_where_to_get_what_is_missing(toolchain, tmp_path):
    tool("g++", "clang++")
    (tmp_path / "include").symlink_to(toolchain / "include")
    told = configured(tmp_path / "none")
    assert "headers (onnxruntime_cxx_api.h, of 1.21 or newer) are not found. Pass -DORT_ROOT=FOLDER" in told
    assert "libonnxruntime-dev" in told and "docs/embed/c-library.md" in told
    python = tool("false")
    told = configured(tmp_path / "no-library", f"-DORT_ROOT={tmp_path}", f"-DPython3_EXECUTABLE={python}")
    assert "library is not found. Pass -DORT_ROOT=FOLDER" in told and "pip install onnxruntime" in told
    told = configured(tmp_path / "python", f"-DORT_ROOT={tmp_path}", f"-DPython3_EXECUTABLE={sys.executable}")
    assert "capi/libonnxruntime.so.1." in told and "Generating done" in told
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libonnxruntime.so.1.99.9").write_text("")
    told = configured(tmp_path / "folder", f"-DORT_ROOT={tmp_path}", f"-DPython3_EXECUTABLE={python}")
    assert f"{tmp_path}/lib/libonnxruntime.so.1.99.9" in told and "Generating done" in told


def test_python_as_the_docs_show(prefix):
    environment = os.environ | {"LD_LIBRARY_PATH": str(prefix / "lib")}
    outcome = subprocess.run([sys.executable, "-c", shown("python")], env=environment, capture_output=True, text=True)
    assert outcome.stdout == f"{ngpt.__version__}\n", outcome.stderr
