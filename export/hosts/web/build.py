"""One HTML file that runs a network in a browser, without a server: ONNX Runtime, the model and an example inside.

npm install --prefix FOLDER onnxruntime-web@1.30.0
ngpt render glossy --spp 16 --size 192x144 -o example.exr
python -m export.hosts.web.build --runtime FOLDER/node_modules/onnxruntime-web --example example.exr -o ngpt.html
"""

import argparse
import base64
import hashlib
import json
import re
import sys
import zlib
from pathlib import Path

import ngpt
from ngpt.errors import NgptError
from ngpt.system.writing import write_text

HERE = Path(__file__).parent
MODEL = Path(ngpt.__file__).parent / "weights" / "ngpt-fast.onnx"

# Of onnxruntime-web: its script without other backends, what loads its WebAssembly, and that.
RUNTIME = ("dist/ort.wasm.min.js", "dist/ort-wasm-simd-threaded.mjs", "dist/ort-wasm-simd-threaded.wasm")


def build(output: Path, runtime: Path, example: Path, model: Path = MODEL, overwrite: bool = False) -> Path:
    """Writes the page and returns its path.

    ``runtime``  the folder of the npm package onnxruntime-web
    ``example``  a gradient stack that the page reads: scan lines, uncompressed or ZIP
    ``model``    model.onnx, beside it model.statistics.onnx

    Raises NgptError for files that cannot be read, or where ``output`` exists and may not be overwritten.
    """
    script, glue, wasm = (_read(runtime / name) for name in RUNTIME)
    worker = script + b"\n" + (_body(HERE.parent / "javascript" / "model.mjs") + _body(HERE / "worker.mjs")).encode()
    data = {
        "worker": worker,
        "glue": glue,
        "wasm": wasm,
        "model": _read(model),
        "statistics": _read(model.with_suffix(".statistics.onnx")),
        "stack": _read(example),
    }
    version = json.loads(_read(runtime / "package.json"))["version"]
    page = _read(HERE / "index.html").decode()
    parts = {
        "SCRIPT": _body(HERE / "exr.mjs") + _body(HERE / "page.mjs"),
        "DATA": "\n".join(_embedded(name, content) for name, content in data.items()),
        "FOOTER": f"ngpt {ngpt.__version__}, {model.stem}, ONNX Runtime {version}",
    }
    page = re.sub(r"{{(SCRIPT|DATA|FOOTER)}}", lambda match: parts[match[1]], page)
    for tag in ("style", "script"):
        text = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)[-1]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        page = page.replace(f"{{{{{tag.upper()}_HASH}}}}", f"sha256-{digest}", 1)
    write_text(output, page, overwrite)
    return output


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise NgptError(f"{path}: cannot be read: {error.strerror or error}") from error


def _body(path: Path) -> str:
    """A module as a piece of one script, which holds what it imports already."""
    text = re.sub(r"^import .*?;\n", "", _read(path).decode(), flags=re.MULTILINE)
    return "\n" + re.sub(r"^export ", "", text, flags=re.MULTILINE)


def _embedded(name: str, content: bytes) -> str:
    packed = base64.b64encode(zlib.compress(content, 9)).decode()
    return f'<script type="application/octet-stream" id="{name}">{packed}</script>'


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m export.hosts.web.build", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--runtime", type=Path, required=True, help="folder of the npm package onnxruntime-web")
    parser.add_argument("--example", type=Path, required=True, help="gradient stack to show at first")
    parser.add_argument("--model", type=Path, default=MODEL, help="default: ngpt-fast.onnx")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--force", action="store_true", help="overwrite a file that exists")
    given = parser.parse_args(arguments)
    try:
        path = build(given.output, given.runtime, given.example, given.model, given.force)
    except NgptError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
