"""The page: its reader of stacks, in Node, and the whole of it in a browser; see docs/embed/hosts.md."""

import base64
import json
import re
import subprocess
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from browser import Session
from exr_files import noise, same_bits, window, write_raw
from hosts import HOSTS, VECTOR, agree, node, node_modules, read_layers, repeated, stack_of

import ngpt
from ngpt.methods import reconstruct
from ngpt.subpixels import means

LETTERS = {"normal": "XYZ", "depth": "Z"}

# --- the reader ------------------------------------------------------------------------------------------------------

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
    letters = LETTERS.get(name, "RGB")
    return {c if name == root else f"{name}.{c}": plane for c, plane in zip(letters, layer, strict=True)}


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
    fine = rng.random((10, 14, 3)).astype(np.float32)
    stack = ngpt.GradientStack({"primal": means(fine, 2)}, fine={"primal": fine})
    *answers, coarse = read_in_node(*paths, ngpt.write(tmp_path / "subpixels.exr", stack))
    for answer in answers:
        assert (answer["width"], answer["height"]) == (29, 37) and set(answer["layers"]) == {"primal", "dx", "albedo"}
        assert same_bits(answer["layers"]["primal"], primal) and same_bits(answer["layers"]["dx"], dx)
        np.testing.assert_array_equal(answer["layers"]["albedo"], half.astype(np.float32))
    # Subpixels are ignored.
    assert set(coarse["layers"]) == {"primal"}
    assert same_bits(coarse["layers"]["primal"], stack["primal"].transpose(2, 0, 1))


def test_the_reader_says_what_it_cannot_read(tmp_path, rng):
    image = dict(zip("RGB", rng.random((3, 40, 24)).astype(np.float32), strict=True))
    words = {}
    for name in ("RLE", "PIZ", "DWAB"):
        compression = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}
        words[write_raw(tmp_path / f"{name}.exr", (image, compression))] = f"compression is {name};"
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    words[write_raw(tmp_path / "tiled.exr", (image, tiles))] = "tiled"
    smooth = {name: np.round(plane) for name, plane in image.items()}  # so that blocks are compressed
    good = write_raw(tmp_path / "good.exr", (smooth,)).read_bytes()
    for name, data, word in (
        ("text.exr", b"not an image at all", "not an OpenEXR"),
        ("cut.exr", good[: len(good) // 2], "cut"),
        ("head.exr", good[:99], "cut"),
        ("damaged.exr", good[:-90] + bytes(90), "damaged"),
    ):
        (tmp_path / name).write_bytes(data)
        words[tmp_path / name] = word
    for word, answer in zip(words.values(), read_in_node(*words), strict=True):
        assert isinstance(answer, str) and word in answer


# --- the page --------------------------------------------------------------------------------------------------------


def write_stack(path, layers) -> Path:
    planes = {k: v for name, a in layers.items() if name != "image" for k, v in channels(name, a[0]).items()}
    return write_raw(path, (planes,))


def test_the_page_is_one_file_that_asks_for_no_other(tmp_path, capsys):
    from export.hosts.web.build import main

    runtime = tmp_path / "runtime"  # its files are there, and do nothing
    (runtime / "dist").mkdir(parents=True)
    for name in ("ort.wasm.min.js", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm"):
        (runtime / "dist" / name).write_text("")
    (runtime / "package.json").write_text('{"version": "1.2.3"}')
    example = write_stack(tmp_path / "example.exr", read_layers(VECTOR))
    arguments = ["--runtime", str(runtime), "--example", str(example), "-o", str(tmp_path / "page.html")]
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

    def send(self, layers, tile):
        """Has the worker reconstruct layers that are in no file."""
        data = {name: base64.b64encode(layer.tobytes()).decode() for name, layer in layers.items()}
        height, width = layers["primal"].shape[2:]
        self.ask(f"""worker.then(worker => {{
            const layers = {json.dumps(data)}, width = {width}, height = {height};
            for (const name in layers)
                layers[name] = new Float32Array(Uint8Array.from(atob(layers[name]), c => c.charCodeAt(0)).buffer);
            root.dataset.ready = "false";
            stack = {{turn: ++turn, name: "layers", width, height, layers}};
            worker.postMessage({{turn, layers, width, height, tile: {tile}}});
        }})""")
        self.settle()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    from export.hosts.web.build import build

    runtime, folder = node_modules("onnxruntime-web", "web"), tmp_path_factory.mktemp("page")
    example = write_stack(folder / "example.exr", read_layers(VECTOR))
    return build(folder / "page.html", runtime, example).as_uri()


@pytest.fixture(scope="module")
def page(chromium, address):
    with closing(Page(chromium, address)) as session:
        yield session


def test_the_page_agrees_with_python(chromium, address):
    layers = read_layers(VECTOR)
    # A page of its own: another one shows what the test before has given it.
    with closing(Page(chromium, address)) as page:
        assert page.ask("root.dataset.error ?? null") is None
        assert re.fullmatch(r"example.exr: 29x23 in .* s, after .* s of loading", page.ask("$('status').textContent"))
        assert same_bits(page.pixels("stack.layers.primal"), layers["primal"])
        agree(page.pixels("clean"), layers["image"])


def test_tiles_of_the_page_agree_with_the_whole(page):
    layers = repeated(23, 440)
    page.send(layers, 96)
    agree(page.pixels("clean"), reconstruct(stack_of(layers), "ngpt-fast").image.transpose(2, 0, 1)[None])


def test_keys_mouse_and_exposure(page):
    def split():
        return float(page.ask("$('wipe').getAttribute('aria-valuenow')"))

    left, top, width, height = page.ask(
        "(({x, y, width, height}) => [x, y, width, height])($('frame').getBoundingClientRect())"
    )
    for event, x in (("mousePressed", 0.5), ("mouseMoved", 0.25), ("mouseReleased", 0.25)):
        page.mouse(event, left + x * width, top + 0.5 * height)
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
