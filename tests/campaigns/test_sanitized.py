"""The C library under sanitizers: all its functions, networks that lie, arguments at random, threads, no memory."""

import os
import re
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from capi import FAST, PRIMAL, SOURCE, command, install, tool
from hostile_networks import hostile, network, reshaped
from reliability import record

pytest.importorskip("onnx")
pytestmark = pytest.mark.slow

HERE = Path(__file__).parents[1] / "export"
ADDRESS = "-fsanitize=address,undefined -fno-sanitize-recover=all -g"
THREAD = "-fsanitize=thread -g"
CALLS = 100_000
# What `front` counts.
STATUSES = ("OK", "BAD_ARGUMENT", "MISSING_LAYER", "BAD_NETWORK", "OUT_OF_MEMORY", "CANCELLED", "FAILED")


def has(compiler, flags, folder) -> bool:
    probe = [compiler, *flags.split(), "-x", "c", "-", "-o", folder / "probe"]
    text = "int main(void) { return 0; }"
    return not subprocess.run(list(map(str, probe)), input=text, text=True, capture_output=True).returncode


class Sanitized:
    """The library, built with a compiler's flags, and programs that use it."""

    def __init__(self, flags, folder, toolchain, *options):
        if not has(tool("gcc", "clang"), flags, folder):
            pytest.skip(f"the compiler has no {flags.split()[0]}")
        self.flags, self.folder = flags.split(), folder
        self.prefix = install(toolchain, folder, f"-DCMAKE_CXX_FLAGS={flags}", "-DCMAKE_BUILD_TYPE=Debug", *options)

    def run(self, program, *arguments) -> str:
        built = self.folder / program
        if not built.exists():
            strict = ["-Wall", "-Wextra", "-Werror", "-pthread", HERE / f"{program}.c", "-o", built]
            libraries = [f"-I{self.prefix}/include", f"-L{self.prefix}/lib", f"-Wl,-rpath,{self.prefix}/lib", "-lngpt"]
            command(tool("gcc", "clang"), *self.flags, *strict, *libraries)
        return done([built, *arguments])


def done(arguments, **environment) -> str:
    """What a program prints; it must end well, and the sanitizers must have nothing to say."""
    known = os.environ | environment
    outcome = subprocess.run([*map(str, arguments)], capture_output=True, text=True, timeout=550, env=known)
    assert outcome.returncode == 0, outcome.stderr[-6000:]
    # Debian's ONNX Runtime does so as it is loaded.
    others = [line for line in outcome.stderr.splitlines() if not line.startswith("Schema error: ")]
    assert not others, "\n".join(others[:50])
    return outcome.stdout


@pytest.fixture(scope="module")
def sanitized(toolchain, tmp_path_factory):
    return Sanitized(ADDRESS, tmp_path_factory.mktemp("address"), toolchain)


@pytest.fixture(scope="module")
def networks(tmp_path_factory) -> list[Path]:
    """Small ones: right, cut into tiles, wrong as they run, without statistics."""
    folder = tmp_path_factory.mktemp("networks")
    tiled = {"ngpt.bytes per pixel": "65536"}
    made = [network(folder / "right.onnx"), network(folder / "tiles.onnx", metadata=tiled)]
    made += [network(folder / "wrong.onnx", reshaped(1, 8, 8, 3)), network(folder / "alone.onnx", metadata=tiled)]
    made[3].with_suffix(".statistics.onnx").unlink()
    return made


def test_shipped_networks(sanitized):
    assert sanitized.run("open", FAST, PRIMAL) == "0 \n0 \n"


def test_networks_that_lie(sanitized, tmp_path):
    paths = hostile(tmp_path)
    # Its answer is an exception, for which the sanitizer ends the process.
    del paths["very large"]
    lines = sanitized.run("open", *paths.values(), network(tmp_path / "right.onnx")).splitlines()
    assert len(lines) == len(paths) + 1
    told = dict(zip(paths, lines, strict=False))
    assert lines[-1] == "0 " and not any(line.startswith("0 ") for line in told.values()), told
    record("Networks of the C library that lie, under sanitizers", len(told), {"named error": len(told)})


def test_arguments_at_random(sanitized, networks):
    clock = time.monotonic()
    counts = [int(number) for number in sanitized.run("front", 1, CALLS, *networks).split()]
    assert sum(counts) >= CALLS and all(counts)
    record(
        "Calls of the C library at random, under sanitizers",
        sum(counts),
        dict(zip(STATUSES, counts, strict=True)),
        seconds=round(time.monotonic() - clock),
    )


def test_threads(sanitized, networks):
    assert sanitized.run("threads", networks[1], 8, 40) == ""


def test_threads_race_for_nothing(toolchain, networks, tmp_path):
    assert Sanitized(THREAD, tmp_path, toolchain).run("threads", networks[1], 4, 20) == ""


def test_allocations_that_fail(sanitized, networks, tmp_path):
    """Each in its turn, one at a time: the call answers so, and leaks nothing."""
    cache = (sanitized.folder / "build" / "CMakeCache.txt").read_text()
    include, library = (re.search(rf"ORT_{name}:\w+=(.*)", cache)[1] for name in ("INCLUDE", "LIBRARY"))
    alias = next(sanitized.prefix.glob("lib/libonnxruntime.so.1"), Path(library))
    options = ["-std=c++17", '-DNGPT_VERSION="0"', "-static-libstdc++", f"-Wl,--version-script={SOURCE / 'ngpt.map'}"]
    sources = [HERE / "allocation.cpp", *SOURCE.glob("*.cpp"), f"-I{SOURCE}", "-isystem", include, alias]
    program = tmp_path / "allocation"
    paths = [f"-Wl,-rpath,{alias.parent}", f"-Wl,-rpath,{Path(library).parent}", "-pthread", "-o", program]
    command(tool("g++", "clang++"), *sanitized.flags, *options, *sources, *paths)
    clock, outcome = time.monotonic(), done([program, networks[1]])
    counts = np.array(re.findall(r": (\d+), survived (\d+)", outcome), int)
    assert len(counts) == 10 and (counts[:, 0] > 0).all(), outcome
    failed, survived = map(int, counts.sum(0))
    assert survived < 0.1 * failed, outcome
    record(
        "Allocations of the C library that fail, under sanitizers",
        failed,
        {"OUT_OF_MEMORY": failed - survived, "done without": survived},
        seconds=round(time.monotonic() - clock),
    )
