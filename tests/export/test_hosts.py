"""The hosts in other languages: each is built and run, and must agree with ONNX Runtime in Python.

C++ wants a compiler and ONNX Runtime's headers and library, of the system or in ORT_ROOT; Node and the browser want
onnxruntime-node and onnxruntime-web in a node_modules that NODE_PATH names, or beside the host. See
docs/embed/hosts.md.
"""

import base64
import json
import re
import subprocess
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from browser import Session
from exr_files import noise, same_bits, window, write_raw
from hosts import HOSTS, VECTOR, agree, caller, cpp_host, node, node_host, node_modules, read_layers, read_pfm

import ngpt
from ngpt.cli import main
from ngpt.io.rawlayers import write_layers
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

ort = pytest.importorskip("onnxruntime")

MODEL = Path(ngpt.__file__).parent / "weights" / "ngpt-fast.onnx"
LETTERS = {"normal": "XYZ", "depth": "Z"}


# --- what is expected ------------------------------------------------------------------------------------------------


def write_vector(folder, layers) -> Path:
    write_layers(folder, layers)
    return folder


def repeated(height, width) -> dict[str, np.ndarray]:
    """The vector's layers again and again, sixteen times as bright at the right as at the left."""
    brightness, layers = np.exp2(4 * np.arange(width) / width), {}
    for name, layer in read_layers(VECTOR).items():
        if name != "image":
            power = 2 if name.endswith("_var") else 0 if name in ("albedo", "normal", "depth") else 1
            many = np.tile(layer, (1, 1, -(-height // 23), -(-width // 29)))[:, :, :height, :width]
            layers[name] = (many * brightness**power).astype(np.float32)
    return layers


@pytest.fixture(scope="module")
def python():
    """ONNX Runtime in Python: layers in, image out."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(MODEL, options, providers=["CPUExecutionProvider"])
    return lambda layers: session.run(["image"], layers)[0]


@pytest.fixture(scope="module")
def wide(tmp_path_factory, python):
    """A folder with layers so wide that tiles do not see all of them, and their image."""
    layers = repeated(23, 440)
    return write_vector(tmp_path_factory.mktemp("wide") / "layers", layers), python(layers)


# --- C++ and Node, which are called alike --------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[cpp_host, node_host], ids=["cpp", "node"])
def host(request, toolchain, tmp_path_factory):
    return caller(request.param(tmp_path_factory.mktemp("host")))


def test_the_vector_is_what_denoise_makes_of_all_that_goes_wrong():
    layers = read_layers(VECTOR)
    image = layers.pop("image")
    stack = GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})
    result = reconstruct(stack, "ngpt-fast")
    agree(image, result.image.transpose(2, 0, 1)[None])
    assert np.nanmax(layers["direct"]) > 50 and result.repaired == 5 + 49 and result.untrusted > 100


def test_a_host_agrees_with_the_vector(host, tmp_path):
    result = host(MODEL, VECTOR, tmp_path / "image.pfm", 0, 2)
    assert re.fullmatch(r"(\d+\.\d ms\n){2}", result.stdout) and not result.stderr, result
    agree(read_pfm(tmp_path / "image.pfm"), read_layers(VECTOR)["image"])


def test_a_host_gives_the_pixels_of_denoise(host, tmp_path):
    """With light that gradients do not hold, to 1e-5 of the largest value."""
    layers = {name: layer for name, layer in read_layers(VECTOR).items() if name != "image"}
    assert np.nanmax(layers["caustic"]) > 5
    stack = GradientStack.from_arrays(**{name: layer[0].transpose(1, 2, 0) for name, layer in layers.items()})
    assert host(MODEL, VECTOR, tmp_path / "image.pfm").returncode == 0
    expected = reconstruct(stack, "ngpt-fast").image.transpose(2, 0, 1)[None]
    assert np.abs(read_pfm(tmp_path / "image.pfm") - expected).max() <= 1e-5 * expected.max()


def test_tiles_of_a_host_agree_with_the_whole(host, wide, tmp_path):
    folder, expected = wide
    # MiB in C++; in Node pixels, no multiple of the alignment: the host must make one of it.
    result = host(MODEL, folder, tmp_path / "image.pfm", 27)
    assert result.returncode == 0, result.stderr
    agree(read_pfm(tmp_path / "image.pfm"), expected)


def test_a_host_needs_no_light_kept_apart(host, python, tmp_path):
    apart = {"direct": 0, "caustic": 0, "caustic_var": -1}
    layers = {name: layer for name, layer in read_layers(VECTOR).items() if name not in ("image", *apart)}
    result = host(MODEL, write_vector(tmp_path / "layers", layers), tmp_path / "image.pfm")
    assert result.returncode == 0, result.stderr
    absent = {name: np.full_like(layers["primal"], value) for name, value in apart.items()}
    agree(read_pfm(tmp_path / "image.pfm"), python(layers | absent))


def test_a_host_says_what_is_wrong(host, tmp_path):
    def refused(status, message, *arguments):
        result = host(*arguments)
        assert result.returncode == status and re.search(message, result.stderr), result
        assert result.stderr.count("\n") == 1 and not list(tmp_path.glob("*.pfm"))

    output = tmp_path / "image.pfm"
    refused(2, "usage", MODEL)
    refused(2, "usage", MODEL, VECTOR, output, "-5")
    refused(2, "usage", MODEL, VECTOR, output, 0, "many")
    refused(1, "none.onnx", tmp_path / "none.onnx", VECTOR, output)
    refused(1, "statistics|ngpt.inputs", MODEL.with_suffix(".statistics.onnx"), VECTOR, output)
    layers = read_layers(VECTOR)
    refused(
        1, "albedo", MODEL, write_vector(tmp_path / "a", {n: x for n, x in layers.items() if n != "albedo"}), output
    )
    other = write_vector(tmp_path / "b", layers | {"depth": layers["depth"][..., 1:]})
    refused(1, "depth", MODEL, other, output)


@pytest.mark.parametrize("path", [HOSTS / "cpp" / "host.cpp", HOSTS / "node" / "host.mjs"], ids=lambda path: path.name)
def test_hosts_are_short(path):
    assert path.read_text().count("\n") < 50


# --- the browser's reader of stacks, in Node -------------------------------------------------------------------------

READER = """
const {readStack} = await import(process.argv[1]), {readFileSync} = await import("node:fs");
const answers = [];
for (const path of process.argv.slice(2)) try {
  const bytes = readFileSync(path), {width, height, layers} = await readStack(Uint8Array.from(bytes).buffer);
  for (const name in layers) layers[name] = Buffer.from(layers[name].buffer).toString("base64");
  answers.push({width, height, layers});
} catch (error) { answers.push(error.message); }
console.log(JSON.stringify(answers));
"""


def read_in_node(*paths) -> list:
    command = [node(), "--input-type=module", "-e", READER, (HOSTS / "web" / "exr.mjs").as_uri(), *map(str, paths)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, result.stderr
    answers = json.loads(result.stdout)
    for answer in answers:
        if isinstance(answer, dict):
            for name, text in answer["layers"].items():
                pixels = np.frombuffer(base64.b64decode(text), "<f4")
                answer["layers"][name] = pixels.reshape(-1, answer["height"], answer["width"])
    return answers


def channels(name, layer, root="primal") -> dict[str, np.ndarray]:
    """A layer (C, H, W) as channels of an EXR."""
    return {
        letter if name == root else f"{name}.{letter}": plane
        for letter, plane in zip(LETTERS.get(name, "RGB"), layer, strict=True)
    }


def test_the_reader_gives_the_bits_that_were_written(tmp_path, rng):
    primal, dx, half = (noise(rng, (3, 37, 29), dtype) for dtype in (np.float32, np.float32, np.float16))
    everything = channels("primal", primal) | channels("dx", dx) | channels("albedo", half) | {"A": half[0]}
    header = {"dataWindow": window(-5, 3, 29, 37), "displayWindow": window(0, 0, 40, 50)}
    paths = [
        write_raw(tmp_path / f"{name}.exr", (everything, header | {"compression": getattr(OpenEXR, name)}))
        for name in ("NO_COMPRESSION", "ZIPS_COMPRESSION", "ZIP_COMPRESSION")
    ]
    zeros = dict.fromkeys("RGB", np.zeros((37, 29), np.float32))  # so that blocks do become smaller
    parts = ((zeros, {}, "ngpt"), (channels("primal", primal, "") | channels("dx", dx), {}, "beauty"))
    paths.append(write_raw(tmp_path / "parts.exr", *parts, (dict(zip("RGB", half, strict=True)), {}, "albedo")))
    for answer in read_in_node(*paths):
        assert (answer["width"], answer["height"]) == (29, 37) and set(answer["layers"]) == {"primal", "dx", "albedo"}
        assert same_bits(answer["layers"]["primal"], primal) and same_bits(answer["layers"]["dx"], dx)
        np.testing.assert_array_equal(answer["layers"]["albedo"], half.astype(np.float32))


def test_the_reader_says_what_it_cannot_read(tmp_path, rng):
    image = dict(zip("RGB", rng.random((3, 40, 24)).astype(np.float32), strict=True))
    compressions = ("RLE", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
    paths = [
        write_raw(tmp_path / f"{name}.exr", (image, {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}))
        for name in compressions
    ]
    for name, answer in zip(compressions, read_in_node(*paths), strict=True):
        assert f"compression is {name};" in answer
    smooth = {name: np.round(plane) for name, plane in image.items()}  # so that blocks are compressed
    good = write_raw(tmp_path / "good.exr", (smooth,)).read_bytes()
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    tiled = write_raw(tmp_path / "tiled.exr", (image, tiles))
    other = {
        "no.exr": b"",
        "text.exr": b"not an image at all",
        "cut.exr": good[: len(good) // 2],
        "head.exr": good[:99],
    }
    other["damaged.exr"] = good[:-90] + bytes(90)
    for name, data in other.items():
        (tmp_path / name).write_bytes(data)
    answers = read_in_node(tiled, *(tmp_path / name for name in other))
    for answer, words in zip(
        answers, ("tiled", "not an OpenEXR", "not an OpenEXR", "cut", "cut", "damaged"), strict=True
    ):
        assert isinstance(answer, str) and words in answer, answer


# --- the page --------------------------------------------------------------------------------------------------------


def write_stack(path, layers) -> Path:
    return write_raw(
        path, ({k: v for name, a in layers.items() if name != "image" for k, v in channels(name, a[0]).items()},)
    )


@pytest.fixture(scope="module")
def fake_runtime(tmp_path_factory):
    """The folder of a package whose files are there, and do nothing."""
    folder = tmp_path_factory.mktemp("runtime")
    (folder / "dist").mkdir()
    for name in ("ort.wasm.min.js", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm"):
        (folder / "dist" / name).write_text("")
    (folder / "package.json").write_text('{"version": "1.2.3"}')
    return folder


def test_the_page_is_one_file_that_asks_for_no_other(fake_runtime, tmp_path, capsys):
    from export.hosts.web.build import main

    example = write_stack(tmp_path / "example.exr", read_layers(VECTOR))
    arguments = ["--runtime", str(fake_runtime), "--example", str(example), "-o", str(tmp_path / "page.html")]
    assert main(arguments) == 0
    text = (tmp_path / "page.html").read_text()
    assert not re.search(r"{{|https?:|//[a-z]+\.|@import|url\(|\bfetch\(|<link|<iframe|^import |^export ", text, re.M)
    assert "ONNX Runtime 1.2.3" in text
    assert main(arguments) == 1
    assert main([*arguments[:1], str(tmp_path), *arguments[2:], "--force"]) == 1
    errors = capsys.readouterr().err
    assert "exists already" in errors and "ort.wasm.min.js: cannot be read" in errors
    assert (tmp_path / "page.html").read_text() == text


class Page(Session):
    """The page in a browser, with time for the model to be loaded and run."""

    def settle(self):
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if self.ask("root.dataset.ready") == "true" or self.ask("root.dataset.error"):
                return
            time.sleep(0.1)
        pytest.fail(f"the page never became ready: {self.ask('$(`status`).textContent')}")

    def pixels(self, expression) -> np.ndarray:
        text = f"btoa(Array.from(new Uint8Array(({expression}).buffer), n => String.fromCharCode(n)).join(''))"
        height, width = self.ask("stack.height"), self.ask("stack.width")
        return np.frombuffer(base64.b64decode(self.ask(text)), "<f4").reshape(1, 3, height, width)

    def give(self, path):
        """As if the user had picked the file."""
        self.ask("root.dataset.ready = 'false'; delete root.dataset.error")
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        picker = self.call("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
        self.call("DOM.setFileInputFiles", files=[str(path)], nodeId=picker)
        self.settle()

    def send(self, layers, tile, then=""):
        """Has the worker reconstruct layers that are in no file; runs the script ``then`` before it can answer."""
        data = {name: base64.b64encode(layer.tobytes()).decode() for name, layer in layers.items()}
        height, width = layers["primal"].shape[2:]
        self.ask(f"""worker.then(worker => {{
            const layers = {json.dumps(data)}, width = {width}, height = {height};
            for (const name in layers)
                layers[name] = new Float32Array(Uint8Array.from(atob(layers[name]), c => c.charCodeAt(0)).buffer);
            root.dataset.ready = "false";
            stack = {{turn: ++turn, name: "layers", width, height, layers}};
            worker.postMessage({{turn, layers, width, height, tile: {tile}}});
            {then}
        }})""")
        self.settle()


@pytest.fixture(scope="module")
def page(chromium, tmp_path_factory):
    from export.hosts.web.build import build

    runtime, folder = node_modules("onnxruntime-web", "web"), tmp_path_factory.mktemp("page")
    example = write_stack(folder / "example.exr", read_layers(VECTOR))
    session = Page(folder / "profile", build(folder / "page.html", runtime, example).as_uri())
    yield session
    session.close()


def test_the_page_agrees_with_python(page):
    layers = read_layers(VECTOR)
    assert page.ask("root.dataset.error ?? null") is None
    assert re.fullmatch(r"example.exr: 29x23 in .* s, after .* s of loading", page.ask("$('status').textContent"))
    assert same_bits(page.pixels("stack.layers.primal"), layers["primal"])
    agree(page.pixels("clean"), layers["image"])


def test_tiles_of_the_page_agree_with_the_whole(page, wide):
    folder, expected = wide
    page.send(read_layers(folder), 96)
    agree(page.pixels("clean"), expected)


def test_keys_mouse_and_exposure(page):
    def split():
        return float(page.ask("$('wipe').getAttribute('aria-valuenow')"))

    left, top, width, height = page.ask(
        "(({x, y, width, height}) => [x, y, width, height])($('frame').getBoundingClientRect())"
    )
    page.mouse("mousePressed", left + 0.5 * width, top + 0.5 * height)
    page.mouse("mouseMoved", left + 0.25 * width, top + 0.5 * height)
    page.mouse("mouseReleased", left + 0.25 * width, top + 0.5 * height)
    assert split() == pytest.approx(25, abs=0.2)
    before = split()
    page.key("ArrowRight")
    assert split() == pytest.approx(before + 1)
    page.key("Home")
    assert split() == 0 and page.ask("$('noisy').style.clipPath") == "inset(0px 100% 0px 0px)"
    page.ask("probe = new OffscreenCanvas(1, 1).getContext('2d', {willReadFrequently: true})")
    colour = "probe.drawImage($('clean'), 3, 3, 1, 1, 0, 0, 1, 1); Array.from(probe.getImageData(0, 0, 1, 1).data)"
    first = page.ask(colour)
    page.ask("$('exposure').value = -1; $('exposure').oninput()")
    assert page.ask("$('stops').textContent") == "-1.00"
    assert all(darker < colour for darker, colour in zip(page.ask(colour)[:3], first[:3], strict=True))


def test_the_page_says_what_is_wrong_and_goes_on(page, tmp_path):
    layers = read_layers(VECTOR)
    page.give(write_stack(tmp_path / "plain.exr", {"primal": layers["primal"], "depth": layers["depth"]}))
    message = page.ask("$('problem').textContent")
    assert message.startswith("plain.exr: the network needs the layers dx, dy, albedo, normal, primal_var")
    (tmp_path / "text.exr").write_text("not an image")
    page.give(tmp_path / "text.exr")
    page.give(tmp_path / "text.exr")  # a file may be picked again: it may be another one by now
    assert page.ask("$('problem').textContent") == "text.exr: it is not an OpenEXR file"
    page.ask("$('example').click()")
    page.settle()
    assert page.ask("$('problem').hidden") is True and page.ask("root.dataset.error ?? null") is None
    agree(page.pixels("clean"), layers["image"])
    assert page.complaints == []


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["diffuse", "glossy", "environment", "lens"])
def test_the_page_on_the_stacks_of_the_demo(page, renderer, scene, tmp_path):
    stack = tmp_path / "stack.exr"
    assert main(["render", scene, "--spp", "16", "--size", "240x160", "-o", str(stack), "--quiet"]) == 0
    page.give(stack)
    agree(page.pixels("clean"), reconstruct(ngpt.read(stack), "ngpt-fast").image.transpose(2, 0, 1)[None])


def test_what_export_writes_runs_in_node(tmp_path):
    """A network of one's own, whole and in tiles. Without its statistics it runs whole, and tiles are refused."""
    host = caller(node_host(tmp_path))
    torch = pytest.importorskip("torch")
    from ngpt.network.model import ModelConfig, Reconstructor
    from ngpt.network.weights import save_weights

    torch.manual_seed(0)
    inputs = ("primal", "dx", "dy", "albedo", "normal", "depth")
    model = Reconstructor(ModelConfig("dense", (4, 4), (1, 1), inputs))
    save_weights(tmp_path / "mine.safetensors", model, {})
    mine, output = tmp_path / "mine.onnx", tmp_path / "image.pfm"
    assert main(["export", "--weights", str(tmp_path / "mine.safetensors"), "-o", str(mine)]) == 0
    images = []
    for tile in (0, 16):
        done = host(mine, VECTOR, output, tile)
        assert done.returncode == 0, done.stderr
        images.append(read_pfm(output))
    agree(*images)
    mine.with_suffix(".statistics.onnx").unlink()
    assert host(mine, VECTOR, output).returncode == 0
    agree(read_pfm(output), images[0])
    done = host(mine, VECTOR, output, 16)
    assert done.returncode == 1 and "mine.statistics.onnx" in done.stderr
