"""Hosts take the layer ``caustic`` out for networks with gradients, and add what ngpt adds, each in its language."""

import shutil
import subprocess

import numpy as np
import pytest
from full_stack import full_stack
from hosts import HOSTS, LIBRARY

from ngpt.denoisers import caustic
from ngpt.io.rawlayers import planes, write_layers
from ngpt.repair import repair
from ngpt.stack import GradientStack

SIZE = (37, 70)


def lit_stack():
    rng = np.random.default_rng(5)
    stack = full_stack(*SIZE)
    smooth = 0 * stack["albedo"] + 0.5
    light = np.where(rng.random((*SIZE, 1)) > 0.9, rng.gamma(0.3, 20, (*SIZE, 3)), 0).astype(np.float32)
    light[10:20, 30:50] += 3
    variance = np.where(light > 4, light**2, 0.1).astype(np.float32)
    stack = stack.replace(albedo=smooth, normal=smooth, primal=stack["primal"] + light)
    return stack.replace(caustic=light, caustic_var=variance)


def check(stack, folder):
    """What the host made: the primal for a network with gradients, and what is added to its image."""
    primal, added = np.fromfile(folder.parent / "made.f32", "<f4").reshape(2, 3, *SIZE)
    noise = np.fromfile(folder.parent / "noise.f32", "<f4").reshape(3, *SIZE)
    whole = np.moveaxis(repair(stack, gradients=False).noise, -1, 0)
    known = np.isfinite(whole)
    assert np.array_equal(np.isfinite(noise).all(axis=0), known.all(axis=0))
    assert np.allclose(noise[known], whole[known], rtol=1e-5)
    data = repair(stack)
    assert np.allclose(primal, np.moveaxis(data.image, -1, 0), rtol=1e-6)
    expected = np.moveaxis(caustic.denoised(data), -1, 0)
    assert np.abs(added - expected).max() < 1e-4 * expected.max()
    assert np.abs(added - expected).max() < 1e-2 * np.median(expected)


@pytest.fixture(params=[True, False], ids=["variance", "no variance"])
def raw(request, tmp_path):
    """A stack, and a folder of its layers as ``ngpt unpack`` writes them."""
    stack = lit_stack()
    if not request.param:
        stack = GradientStack({name: stack[name] for name in stack.names if name != "caustic_var"})
    write_layers(tmp_path / "raw", planes(stack))
    return stack, tmp_path / "raw"


_JAVASCRIPT = """
import {readFileSync, writeFileSync} from "node:fs";
import {withAdded, withoutCaustic} from "CAUSTIC";
const shapes = JSON.parse(readFileSync("raw/layers.json", "utf8")), layers = {};
for (const name of Object.keys(shapes)) {
  const bytes = readFileSync(`raw/${name}.f32`);
  layers[name] = new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
}
const [, , height, width] = shapes.primal.shape, {primal} = layers;
const made = withoutCaustic(layers, ["primal", "dx"], width, height);
const added = withAdded(new Float32Array(primal.length), made.added);
writeFileSync("made.f32", Buffer.concat([made.layers.primal, added].map(each => Buffer.from(each.buffer))));
const other = withoutCaustic(layers, ["primal", "albedo"], width, height);
if (other.added || other.layers.primal !== primal) throw new Error("a network of colour sees all light");
writeFileSync("noise.f32", Buffer.from(other.layers.primal_var.buffer));
"""

_CPP = """
#include "caustic.hpp"
int main() {
    const std::string listing = slurp("raw/layers.json");
    const Layers raw = {{"primal", read_layer("raw", listing, "primal")},
                        {"primal_var", read_layer("raw", listing, "primal_var")}};
    Layers given = raw, all = raw;
    const Layer added = spread(take_out_caustic("raw", {"primal", "dx"}, given)), &primal = given.at("primal");
    std::ofstream file("made.f32", std::ios::binary);
    for (const Layer *layer : {&primal, &added})
        file.write(reinterpret_cast<const char *>(layer->pixels.data()), layer->pixels.size() * sizeof(float));
    const bool none = take_out_caustic("raw", {"primal", "albedo"}, all).empty();
    std::ofstream("noise.f32", std::ios::binary)
        .write(reinterpret_cast<const char *>(all["primal_var"].pixels.data()), primal.pixels.size() * sizeof(float));
    return none && all["primal"].pixels == raw.at("primal").pixels ? 0 : 1;
}
"""


def run(*command, folder):
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=folder)
    assert result.returncode == 0, result.stderr


def test_javascript(raw):
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    stack, folder = raw
    module = (HOSTS / "javascript" / "caustic.mjs").as_uri()
    (folder.parent / "script.mjs").write_text(_JAVASCRIPT.replace("CAUSTIC", module))
    run("node", "script.mjs", folder=folder.parent)
    check(stack, folder)


def test_cpp(raw):
    if shutil.which("g++") is None:
        pytest.skip("g++ is not installed")
    stack, folder = raw
    (folder.parent / "main.cpp").write_text(_CPP)
    paths = [f"-I{path}" for path in (HOSTS / "cpp", LIBRARY)]
    run(
        "g++",
        "-std=c++17",
        "-O2",
        "-Wall",
        "-Wextra",
        "-Werror",
        *paths,
        "main.cpp",
        "-o",
        "main",
        folder=folder.parent,
    )
    run("./main", folder=folder.parent)
    check(stack, folder)
