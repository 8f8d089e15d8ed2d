"""What the commands refuse: one line says why, the exit status says whose fault it is, and no file changes.

A row is a command line in the folder ``shelf``, its exit status (1: a file is at fault, 2: the call is) and words that
its message has.
"""

import io
import shlex
import struct
import sys

import numpy as np
import pytest
from exr_files import window, write_raw
from full_stack import full_stack

import ngpt
from ngpt.cli import main
from ngpt.network.shipped import WEIGHTS
from ngpt.stack import GradientStack
from ngpt.windows import Place, Window

# What must be installed beside the base for the rows of a verb.
NEEDS = {"train": "torch", "export": "onnx"}


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """A folder of good and bad inputs of all kinds, and the empty folder ``out``; no refused command changes it."""
    folder = tmp_path_factory.mktemp("shelf")
    for name in ("out", "empty"):
        (folder / name).mkdir()
    network, bare = (WEIGHTS / "ngpt-fast.onnx").read_bytes(), struct.pack("<Q", 2) + b"{}"
    for name, data in {
        "notes.exr": b"no image",
        "page.html": b"mine",
        "raw": b"mine",
        "older/dy.f32": b"mine",
        "empty.onnx": b"",
        "cut.onnx": network[:5000],
        "statistics.onnx": (WEIGHTS / "ngpt-fast.statistics.onnx").read_bytes(),
        "empty.safetensors": b"",
        "bare.safetensors": bare,
        "nonsense.xml": b'<scene version="3.0.0"><shape type="nonsense"/></scene>',
        "moving.xml": b'<scene version="3.0.0"><sensor type="perspective"><animation name="a"/></sensor></scene>',
        "list/log.jsonl": b"[]\n{}\n",
        "word/log.jsonl": b'{"step": 1, "loss": "low"}\n',
        "bytes/log.jsonl": b"\xff\xfe\n",
        "short/checkpoint.safetensors": b"\0\0",
        "long/checkpoint.safetensors": struct.pack("<Q", 2**60) + b"{}",
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    plain, one = np.ones((4, 5, 3), np.float32), np.ones((4, 5), np.float32)
    images = dict.fromkeys(("plain", "plain2", "shot/1", "shot/2"), plain)
    images |= dict.fromkeys(("noisy", "other"), full_stack(12, 14))
    images |= {"small": plain[:1, :2], "nothing": np.nan * plain}
    for name, x in (("left", 0), ("right", 5)):
        images[name] = GradientStack({"primal": plain}, place=Place(Window(x, 0, 5, 4), Window(0, 0, 10, 4)))
    (folder / "shot").mkdir()
    for name, image in images.items():
        ngpt.write(folder / f"{name}.exr", image)
    (folder / "cut.exr").write_bytes((folder / "noisy.exr").read_bytes()[:2000])
    write_raw(folder / "moved.exr", (dict.fromkeys("RGB", one), {"dataWindow": window(3, 2, 5, 4)}))
    write_raw(folder / "depth.exr", ({"Z": one},))
    eyes = {f"{view}{c}": one for view in ("", "right.") for c in "RGB"}
    write_raw(folder / "eyes.exr", (eyes, {"multiView": ["left", "right"]}))
    return folder


def refused(shelf, line, status, words, monkeypatch, capfd):
    def seen():
        return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in shelf.rglob("*")}

    monkeypatch.chdir(shelf)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO()))
    before = seen()
    try:
        found = main(shlex.split(line))
    except SystemExit as stop:  # of the parser
        found = stop.code
    output, errors = capfd.readouterr()
    assert (found, output) == (status, ""), errors
    (error,) = [one for one in errors.splitlines() if "error:" in one]
    assert error.startswith("ngpt: error: ") and words in error and "Traceback" not in errors
    assert seen() == before


ROWS = [
    ("", 2, "required: VERB"),
    ("frobnicate", 2, "there is no verb 'frobnicate'; verbs: denoise"),
    ("denois plain.exr", 2, "there is no verb 'denois'; did you mean 'denoise'? verbs: denoise, info"),
    ("denoise missing.exr", 1, "missing.exr: not found"),
    ("denoise empty", 1, "no .exr files to denoise there"),
    ("denoise no.%04d.exr", 1, "no.%04d.exr: no frames of that name exist; check the name"),
    ("denoise plain.exr -o x.%04d.exr", 2, "plain.exr: has no number, which x.%04d.exr asks for"),
    ("denoise notes.exr -o out/o.exr", 1, "notes.exr: not an OpenEXR file"),
    ("denoise cut.exr -o out/o.exr", 1, "cut.exr"),
    ("denoise plain.exr -o out/o.exr --method l1", 1, "method 'l1' needs layers 'dx' and 'dy'"),
    ("denoise plain.exr -o out/o.exr --layer dx", 2, "'dx' is not of the form NAME=VALUE"),
    ("denoise plain.exr -o out/o.exr --layer albdo=x", 1, "did you mean 'albedo'? use one of"),
    ("denoise plain.exr -o out/o.tiff", 2, "let the name end in .exr .pfm .png"),
    ("denoise plain.exr -o notes.exr/o.exr", 1, "notes.exr: cannot be made: "),
    ("denoise plain.exr -o notes.exr", 1, "to replace it, or --skip-existing (skip_existing=True) to"),
    ("denoise plain.exr plain2.exr -o out/one.exr", 2, "file; the results of 2 stacks need a folder"),
    ("denoise plain.exr shot/../plain.exr -o out/", 2, "out/plain.exr: would be the result of two"),
    ("denoise plain.exr -o out/o.exr --method odin", 2, "'odin'; did you mean 'oidn'? choose one of: auto"),
    ("denoise plain.exr -o out/o.exr -m l2 -O alhpa=1", 2, "did you mean 'alpha'?"),
    ("denoise noisy.exr other.exr -o out/ -m wcv -O alpha=1", 2, "'wcv' has no option 'alpha'; it has: none"),
    ("denoise noisy.exr other.exr -o out/ -m l1 -O alpha=much", 2, "'l1', option 'alpha': 'much' is not allowed"),
    ("denoise noisy.exr other.exr -o new -m ngpt-fast --weights nowhere.onnx", 1, "nowhere.onnx: "),
    ("denoise noisy.exr other.exr -o new --device toaster", 1, "device 'toaster' is unknown; ONNX Runtime has: cpu"),
    ("denoise noisy.exr other.exr -o new --weights cut.onnx", 1, "cut.onnx: ONNX Runtime cannot load it"),
    ("denoise noisy.exr other.exr -o new -m ngpt --weights empty.safetensors", 1, "not a readable safetensors file"),
    ("denoise noisy.exr other.exr -o new --memory 0", 2, "option 'memory': '0' is not allowed"),
    ("denoise noisy.exr other.exr -o new -O qualty=high", 2, "has an option 'qualty'; did you mean 'quality'?"),
    ("denoise noisy.exr other.exr -o new -O quality=higher", 2, "method 'oidn', option 'quality': 'higher' is not"),
    ("denoise eyes.exr -m primal -o out/a.png", 1, "has several views, and out/a.png is of one; choose one, as in"),
    ("denoise eyes.exr -m primal -o out/a.exr --ref plain.exr", 1, "has several views, and --ref is of one"),
    ("denoise plain.exr --methd l2", 2, "argument '--methd'; did you mean '--method'? see `ngpt denoise --help`"),
    ("denoise plain.exr --skip-existing --force", 2, "not allowed with"),
    ("denoise plain.exr -o out/o.exr --ref small.exr", 1, "small.exr is 2x1 but"),
    ("denoise left.exr -m primal -o out/o.exr --ref right.exr", 1, "these have no pixel in common"),
    ("denoise plain.exr --albedo small.exr", 1, "small.exr: albedo is 2x1 but plain.exr is 5x4; render them at one"),
    ("denoise plain.exr --albedo moved.exr", 1, "moved.exr: albedo starts at pixel (3, 2) but plain.exr at (0, 0)"),
    ("denoise plain.exr --normal depth.exr", 1, "depth.exr: no layer for 'normal' with channels X Y Z"),
    ("denoise plain.exr plain2.exr --albedo small.exr", 2, "--albedo belongs to one stack, and 2 are given"),
    ("denoise noisy.exr other.exr -o out/ --halves noisy.exr other.exr", 2, "--halves belong to one stack"),
    ("denoise noisy.exr -o out/a.pfm -m primal --error", 2, "--error makes layers, and out/a.pfm can have none"),
    ("denoise shot -o out/shot --temporal --error", 2, "--temporal and --error cannot be combined"),
    ("denoise shot -o out/shot --temporal --group 'fog*'", 2, "--temporal and --groups cannot be combined"),
    ("denoise -", 1, "standard input has no name"),
    ("denoise - noisy.exr -o out/", 1, "'-' is one stack, and 2 are given"),
    ("denoise noisy.exr noisy.exr -o -", 1, "'-' is one result, and 2 stacks are given"),
    ("denoise noisy.exr -o - --json", 1, "both want standard output"),
    ("denoise - -o -", 1, "error: standard input: is empty"),
    ("diff plain.exr small.exr", 1, "small.exr is 2x1 but"),
    ("diff plain.exr missing.exr", 1, "missing.exr: not found"),
    ("diff - -", 2, "'-' is one image, and is given 2 times"),
    ("diff left.exr right.exr", 1, "left.exr is 5x4 at (0, 0) of 10x4, right.exr is 5x4 at (5, 0) of 10x4"),
    ("info nowhere.onnx", 1, "nowhere.onnx: not found; check the name"),
    ("info ngpt-fst", 1, "did you mean 'ngpt-fast'?"),
    ("info difuse", 1, "did you mean 'diffuse'?"),
    ("info cut.onnx", 1, "cannot load it"),
    ("info statistics.onnx", 1, "lacks the metadata 'ngpt.inputs'"),
    ("info empty.safetensors", 1, "not a readable safetensors file"),
    ("info bare.safetensors", 1, "holds no configuration of ngpt"),
    ("info short", 1, "is no checkpoint of ngpt, or damaged"),
    ("info long", 1, "is no checkpoint of ngpt, or damaged"),
    ("info list", 1, "line 1 is []; it must be a table"),
    ("info word", 1, "line 1: 'loss' is 'low'"),
    ("info bytes", 1, "cannot be read"),
    ("merge noisy.exr other.exr -o notes.exr", 1, "notes.exr: exists already; pass --force"),
    ("merge noisy.exr noisy.exr -o out/o.exr", 1, "noisy.exr"),
    ("unpack plain.exr -o x", 2, "see `ngpt unpack --help`"),
    ("unpack noisy.exr raw", 1, "raw"),
    ("unpack noisy.exr older", 1, "older"),
    ("report -q plain.exr small.exr -o out/p.html", 1, "small.exr is 2x1 but plain.exr is 5x4; render or crop them to"),
    ("report -q plain.exr plain.exr -o out/p.html", 2, "plain.exr: is given twice"),
    ("report -q nothing.exr --ref plain.exr -o out/p.html", 1, "none of 20 pixels is finite in both images"),
    ("report -q nowhere.exr -o out/p.html", 1, "nowhere.exr"),
    ("report -q plain.exr -o page.html", 1, "exists already; pass --force"),
    ("report -q plain.exr -o out/page", 2, "let it end in .html"),
    ("report -q left.exr right.exr -o out/p.html", 1, "left.exr is 5x4 at (0, 0) of 10x4, right.exr is 5x4 at (5, 0)"),
    ("report -q shot plain.exr -o out/p.html", 1, "plain.exr: is not a folder, but others are"),
    ("picture plain.exr -o out/a.gif", 1, "one of .png .jpg"),
    ("picture shot -o out/a.png", 1, "one of .webp .mp4"),
    ("picture plain.exr -o out/a.png --exposure bright", 2, "nor auto"),
    ("picture plain.exr --view top -o out/a.png", 1, "has no view 'top'; it has only one, without a name"),
    ("picture eyes.exr --view top -o out/a.png", 1, "has no view 'top'; it has left, right"),
    ("picture shot -o out/a.webp --fps 0", 2, "frames a second"),
    ("picture empty -o out/a.webp", 1, "no .exr files"),
    ("render difuse", 1, "did you mean 'diffuse'?"),
    ("render diffuse --sampler gtp", 2, "did you mean 'gpt'?"),
    ("render diffuse --size 0x5", 2, "'0x5' is not a size"),
    ("render diffuse --spp 0", 2, "'0' is not a whole number of 1 or more"),
    ("render diffuse --time 0", 2, "argument --time: '0' is not a"),
    ("render diffuse --memory 0", 2, "argument --memory: '0' is not a"),
    ("render diffuse --seed -1", 2, "argument --seed: '-1' is not a"),
    ("render diffuse -o out/s.tga", 2, "let the name end in .exr"),
    ("demo --scene difuse", 2, "did you mean 'diffuse'?"),
    ("train", 2, "--config is missing: a TOML file, or one of: ablations, "),
    ("train --config papr", 1, "did you mean 'paper'?"),
    ("export --weights empty -o out/o.onnx", 1, "empty: is a directory; name a file in it, or one of: ngpt-combine"),
    ("train --config nowhere.toml --dry-run", 1, "nowhere.toml: cannot be read"),
    ("train --config fast", 2, "--out is missing"),
    ("train --config fast --dry-run --set model.units=3", 1, "units = 3: must be a list"),
    ("train --config fast --dry-run --set model.base=x", 1, "choose one of"),
    ("train --config fast --dry-run --set model.base", 2, "give it as table.key=value"),
    ("train --config tiny --set run.stepz=3", 1, "unknown key 'stepz'; did you mean 'steps'?"),
    ("train --config tiny --out new", 1, "no such folder; make a training set: ngpt dataset --config ... --out "),
    ("train --config tiny --init notes.exr", 1, "notes.exr: exists already; pass --force"),
    ("dataset --config nowhere --out out/x", 1, "nowhere: cannot be read: no such file; ngpt has the configurations"),
    ("evaluate --config eval-mian --out x", 1, "did you mean 'eval-main'?"),
    ("evaluate --config eval-640 --init out/a.toml", 2, "eval-640 only changes numbers of eval-main.toml; give that"),
]


@pytest.mark.parametrize(("line", "status", "words"), ROWS, ids=[line for line, *_ in ROWS])
def test_refused(shelf, line, status, words, monkeypatch, capfd):
    verb = line.partition(" ")[0]
    if verb in NEEDS:
        pytest.importorskip(NEEDS[verb])
    refused(shelf, line, status, words, monkeypatch, capfd)


RENDERS = [
    ("render nonsense.xml", 1, '"nonsense" not found'),
    ("render absent.xml", 1, "absent.xml: no such file"),
    ("render diffuse --variant scalar_rgb", 2, "'scalar_rgb' is no vectorised variant"),
    ("render diffuse --size 30000x30000", 1, "; render a smaller image"),
    ("render absent.xml --spp 9999999999", 2, "9999999999 samples per pixel"),
    ("render diffuse -o notes.exr/s.exr", 1, "notes.exr: cannot be made: "),
    ("render moving.xml", 1, "animated transforms"),
    ("info moving.xml", 1, "animated transforms"),
]


@pytest.mark.parametrize(("line", "status", "words"), RENDERS, ids=[line for line, *_ in RENDERS])
def test_refused_by_the_renderer(renderer, shelf, line, status, words, monkeypatch, capfd):
    refused(shelf, line, status, words, monkeypatch, capfd)
