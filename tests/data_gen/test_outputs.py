"""``ngpt render --denoise``, and pictures of a render: the image that `ngpt denoise` would make, by one command."""

import io
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ngpt
from ngpt.errors import NgptError
from ngpt.image import pictures, transforms
from ngpt.io.openexr import read_exr
from ngpt.methods import METHODS
from ngpt.system.interrupts import Interrupt

pytest.importorskip("mitsuba")

import data_gen
from data_gen import begun, outputs, passes
from data_gen import render as rendering
from data_gen.choosing import plans
from data_gen.cli import render

ANY = "render diffuse --size 16x12"
GPT = f"{ANY} --sampler gpt"


def header(path):
    return read_exr(path).parts[0].header


def same(one, other):
    """Whether two files hold the same, bit for bit, but for the times that it took."""
    (a,), (b,) = (read_exr(path).parts for path in (one, other))
    told = ({k: str(v) for k, v in p.header.items() if "econds" not in k and k != "channels"} for p in (a, b))
    ours, theirs = a.channels, b.channels
    alike = ours.keys() == theirs.keys() and all(np.array_equal(ours[k], theirs[k], equal_nan=True) for k in ours)
    return alike and next(told) == next(told)


def planned(monkeypatch, *plan, of="plan_sampler"):
    monkeypatch.setattr(plans, of, lambda *_, **__: plans.Plan(*plan, "for a test"))


@pytest.fixture
def no_render(renderer, monkeypatch):
    from data_gen.frames import shot

    monkeypatch.setattr(rendering, "render", lambda *_, **__: pytest.fail("rendered"))
    monkeypatch.setattr(shot, "render_shot", lambda *_, **__: pytest.fail("rendered"))


@pytest.mark.parametrize(
    ("more", "method", "kind"),
    [("--spp 4", "", "png"), ("--spp 48 --adaptive --for wcv --diagnostics", "-m wcv", "pfm")],
)
def test_the_image_is_that_of_two_commands(renderer, command, more, method, kind):
    command(f"{GPT} {more} -o stack.exr")
    command(f"denoise stack.exr -o two.exr {method}")
    command(f"{GPT} {more} -o one.exr --denoise --keep kept.exr")
    assert same("two.exr", "one.exr") and same("stack.exr", "kept.exr")
    assert header("one.exr")["ngpt:method"] == ("wcv" if method else "ngpt-combine")
    look = "--transform filmic --exposure 1.5"
    command(f"{GPT} {more} -o one.{kind} {look}")
    command(f"denoise stack.exr -o two.{kind} {look} {method}")
    assert Path(f"one.{kind}").read_bytes() == Path(f"two.{kind}").read_bytes()


def test_a_method_goes_before_the_one_that_samples_are_shared_for(renderer, command):
    command(f"{GPT} --adaptive --for wcv --denoise l1 -o it.exr")
    assert header("it.exr")["ngpt:method"] == "l1" and header("it.exr")["ngpt:adaptive"] == "wcv"
    # The error to reach is the error of the image.
    assert "'wcv' is expected to have an error of" in command(f"{GPT} --error 0.9 --spp 32 --denoise wcv -o it.png")


def test_the_memory_of_a_render_is_free_before_a_method_runs(renderer, command, monkeypatch):
    import drjit as dr

    order, real = [], outputs.reconstruct
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: order.append("freed"))
    monkeypatch.setattr(outputs, "reconstruct", lambda *args: order.append("denoised") or real(*args))
    command(f"{GPT} --spp 2 --denoise l1 -o it.png")
    assert order == ["freed", "denoised"]


def test_the_method_of_a_pilot_is_run_and_its_error_reached(renderer, command, monkeypatch):
    planned(monkeypatch, "primal", "nfor", False, 0.5, of="plan")
    said = command(f"{ANY} --time 9 --for auto --denoise -o it.exr")
    assert header("it.exr")["ngpt:method"] == "nfor" and " s, nfor " in said and "then: ngpt denoise" not in said
    planned(monkeypatch, "primal", "nfor", False, None)
    command(f"{ANY} -o on.exr --spp 4")
    said = command(f"{ANY} -o on.exr --error 0.5 --skip-existing")
    assert "'nfor' is expected to have an error" in said and "which takes method 'nfor'" in said


def test_a_budget_of_processor_time(renderer, command, monkeypatch):
    """It ends the render, by the clock of this process; nobody gives two."""
    asked = []
    monkeypatch.setattr(rendering, "render_passes", lambda *args, **how: asked.append(args[3]) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        command(f"{GPT} --cpu-time 2.5 -o it.exr")
    assert asked[0].clock is time.process_time and 2 < asked[0].seconds <= 2.5 and asked[0].spp is None
    with pytest.raises(NgptError, match="give one of them"):
        data_gen.render_scene("diffuse", seconds=1.0, cpu_seconds=1.0)


def test_the_line_on_what_comes_next_names_the_method_that_it_takes(renderer, command, monkeypatch):
    """One sample per pixel has no variances, so not every method that a render is for can clean it."""
    planned(monkeypatch, "gpt", "wcv", False, None)
    for spp in (1, 2):
        said = command(f"{ANY} --spp {spp} -o {spp}.exr")
        command(f"denoise {spp}.exr -o image{spp}.exr")
        method = header(f"image{spp}.exr")["ngpt:method"]
        assert f"which takes method '{method}'" in said and (method == "wcv") == (spp == 2)


@pytest.mark.parametrize("more", ["--spp 4 --denoise wcv", "--time 60 --for wcv"])
def test_a_method_that_cannot_use_what_was_begun_is_refused(renderer, command, request, more):
    command(f"{ANY} -o 0.exr --spp 2")
    request.getfixturevalue("no_render")
    assert "0.exr renders none" in command(f"{ANY} -o 0.exr --skip-existing {more}", 2)


@pytest.mark.parametrize("kept", [False, True])
def test_a_render_goes_on_and_its_image_is_made_anew(renderer, command, kept):
    """From the result, which has the stack in it, or from the stack that is kept beside a picture."""
    target = Path("it.png" if kept else "it.exr")
    words = f"{GPT} --seed 3 --diagnostics --skip-existing"
    one = f"{words} --denoise wcv -o {target} {'--keep stack.exr' if kept else ''}"
    command(f"{one} --spp 16")
    first = target.read_bytes()
    assert "has 16 samples per pixel; going on with it" in command(f"{one} --spp 48")
    before = target.read_bytes()
    assert before != first
    for spp in (16, 48):
        command(f"{words} -o plain.exr --spp {spp}")
    command(f"denoise plain.exr -m wcv -o again{target.suffix}")
    if kept:
        assert same("stack.exr", "plain.exr") and before == Path("again.png").read_bytes()
    else:
        assert same("it.exr", "again.exr")
    assert "the image is there" in command(f"{one} --spp 48") and target.read_bytes() == before
    if kept:
        target.unlink()
        assert "the stack was there" in command(f"{one} --spp 48") and target.read_bytes() == before
    else:
        # A stack is no image, and a result holds its stack.
        assert "it is a stack" in command(f"{words} --denoise wcv -o plain.exr --spp 48", 1)
        command(f"{words} -o it.exr --spp 64")
        assert "ngpt:method" not in header("it.exr") and "primal.R" not in read_exr("it.exr").parts[0].channels
        assert ngpt.read("it.exr").attributes["ngpt:spp"] == 64


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-o a.exr --denoise wcvv", "invalid choice: 'wcvv'"),
        ("-o a.png --denoise wcv --sampler primal", "needs gradients, and sampler 'primal' renders none"),
        ("-o {frame}.exr --denoise wcv --sampler primal --frames 0:2", "sampler 'primal' renders none"),
        ("-o a.png --denoise ngpt-primal --spp 1", "needs variances"),
        ("-o a.png --denoise nfor", "method 'nfor' cannot be used: none here; name another"),
        ("-o a.png --transform aces", "--transform aces needs OpenColorIO"),
        ("-o a.tga", "stacks are OpenEXR; let the name end in .exr, or for an image in .png"),
        ("-o a.tga --denoise", "results are OpenEXR, PFM or pictures"),
        ("-o there.png", "there.png: exists already; pass --force (overwrite=True) to replace it\n"),
        ("-o a.png --keep there.exr", "there.exr: exists already; pass --force"),
        ("-o a.png --keep b.png", "b.png: stacks are OpenEXR"),
        ("-o a.exr --keep b.exr", "the output is the stack; add --denoise"),
        ("-o a.exr --denoise --keep ./a.exr", "--keep a.exr: is the file of the image"),
        ("-o a.png --frames 0:2", "is one file for 2 frames; write -o 'a.{frame:04d}.png'"),
        ("-o a.png --skip-existing", "keep the stack too: --keep FILE.exr"),
        ("-o {frame}.png --frames 0:2 --skip-existing", "keep the stack too"),
        ("-o {frame}.png --frames 0:2 --keep b.exr", "--keep is for single images"),
        ("-o {frame}.tga --frames 0:2", "stacks are OpenEXR"),
        ("-o - --frames 0:2", "standard output is one file for several frames"),
        ("-o - --json", "--json also wants standard output"),
        ("-o a.exr --for wcv", "--for needs --adaptive or --error"),
        ("-o a.exr --error 5%", "'5%' is not a number; write 0.05"),
        ("-o a.exr --error little", "'little' is not a number; write 0.05 for 5 %"),
        ("-o a.exr --cpu-time 9 --time 9", "not allowed with argument"),
        ("-o a.exr --cpu-time 9 --skip-existing", "no file says how much processor time it took"),
        ("-o {frame}.exr --cpu-time 9 --frames 0:2", "--cpu-time is for single images"),
        ("-o {frame}.exr --error 0.1 --frames 0:2", "--adaptive, --error and --for are for single images"),
        ("-o a.exr --camera x.json", "--frames"),
        ("-o a.exr -D a={frame}", "changes from frame to frame"),
        ("-o a.exr --shard 0/2", "--shard belongs to a shot"),
        ("-o {frame}.exr --frames 0:2 --cluster tcp://nowhere:1 --shard 0/2", "leave --shard out"),
        ("-q -o {frame}.exr --frames 0:2 --dt 1", "use --dt 2"),
        ("-o a.exr --dt 2", "--dt belongs to a shot"),
        ("-o {frame}.exr --frames 0:2 --live", "--live"),
        ("-o {frame}.exr --frames 0:1 --sampler gpt -O history=4", "has no option 'history'"),
    ],
)
def test_what_would_fail_afterwards_is_refused_before(command, no_render, monkeypatch, words, message):
    monkeypatch.setitem(METHODS, "nfor", replace(METHODS["nfor"], missing=lambda: "none here"))
    monkeypatch.setattr(transforms, "find_spec", lambda name: None)
    transforms._aces.cache_clear()
    for name in ("there.png", "there.exr"):
        Path(name).write_text("precious")
    printed = command(f"render diffuse {words}", 1, 2)
    assert message in printed and len(printed.splitlines()) == 1
    assert sorted(path.name for path in Path().iterdir()) == ["there.exr", "there.png"]


def test_a_sampler_that_a_pilot_takes_is_judged_before_its_render(command, no_render, monkeypatch):
    planned(monkeypatch, "primal", "", False, None)
    assert "sampler 'primal' renders none" in command(f"{ANY} --denoise wcv -o a.png", 2)


@pytest.mark.parametrize("error", [NgptError("no luck"), MemoryError(), ValueError("shapes")])
def test_a_method_that_fails_loses_no_sample(renderer, command, monkeypatch, error):
    """What it leaves outlives standard output, and takes a free name."""

    def fails(stack, method):
        raise error

    monkeypatch.setattr(outputs, "reconstruct", fails)
    words = f"{GPT} --spp 4 --denoise -o"
    why = "no luck"
    if not isinstance(error, NgptError):
        why = f"method 'auto' failed: {type(error).__name__}" + (f": {error}" if str(error) else "")
    assert f"{why}; what was rendered is in standard-output.stack.exr" in command(f"{words} -", 1)
    assert ngpt.read("standard-output.stack.exr").attributes["ngpt:spp"] == 4
    Path("it.stack.exr").write_text("precious")
    said = command(f"{words} it.png", 1)
    assert f"error: {why}; it.stack.exr: exists already" in said and "is kept in it.stack.kept.exr" in said
    assert Path("it.stack.exr").read_text() == "precious" and not Path("it.png").exists()
    assert ngpt.read("it.stack.kept.exr").attributes["ngpt:spp"] == 4
    if isinstance(error, NgptError):
        assert "what was rendered" not in command(f"{words} it.png --keep kept.exr", 1) and Path("kept.exr").exists()


def test_a_render_too_wide_for_its_picture_is_kept(renderer, command, monkeypatch):
    monkeypatch.setitem(pictures._LONGEST, ".png", 15)
    said = command(f"{GPT} -q --spp 2 -o it.png", 1)
    assert "16x12 pixels are too many for .png" in said and said.count("\n") == 1
    assert ngpt.read("it.stack.exr").attributes["ngpt:spp"] == 2 and not Path("it.png").exists()


def test_a_picture_that_is_older_than_its_stack_is_made_anew(renderer, command):
    """The stack may have grown by itself, or the process may have ended between both."""
    both = f"{GPT} --skip-existing -o it.png --keep stack.exr --denoise l1"
    command(f"{both} --spp 2")
    before = Path("it.png").read_bytes()
    command(f"{GPT} --skip-existing -o stack.exr --spp 8")
    assert "the stack was there" in command(f"{both} --spp 8") and Path("it.png").read_bytes() != before
    assert "the image is there" in command(f"{both} --spp 8")


@pytest.mark.parametrize("name", ["it.png", "it.exr"])
def test_an_interrupted_render_gives_its_image(renderer, command, monkeypatch, name):
    monkeypatch.setattr(passes, "FIRST_LANES", 16 * 12 * 16)  # several passes
    pressed = Interrupt()
    pressed.signal = 2
    monkeypatch.setattr(render, "stop_on_ctrl_c", contextmanager(lambda told: iter([pressed])))
    said = command(f"{GPT} --spp 64 --denoise -o {name}", 130)
    assert f"{name} holds the 16 samples per pixel done by then" in said and Path(name).exists()
    if name == "it.exr":
        assert begun.begun_stack(name).attributes["ngpt:unfinished"] == "interrupted"


@pytest.mark.parametrize("more", ["", "--denoise wcv"])
def test_standard_output_gets_a_stack_or_its_image(renderer, command, monkeypatch, more):
    class Binary:
        def __init__(self):
            self.buffer, self.errors = io.BytesIO(), "strict"

        isatty, flush = (lambda self: False), (lambda self: None)

    with monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", Binary())
        command(f"{GPT} -q --spp 4 -o - {more}")
        Path("piped.exr").write_bytes(sys.stdout.buffer.getvalue())
    command(f"{GPT} --spp 4 -o it.exr {more}")
    assert same("piped.exr", "it.exr")


def test_frames_are_denoised_one_by_one(renderer, command):
    words = f"{GPT} --frames 0:2 --spp 4"
    clean = f"{words} -o clean --denoise wcv --skip-existing"
    assert " s, wcv " in command(clean)
    command(f"{words} -o shot")
    command("denoise shot -o two -m wcv")
    for name in ("diffuse.0000.exr", "diffuse.0001.exr"):
        assert same(f"clean/{name}", f"two/{name}")
    command(f"{words} -o {{frame}}.png --denoise wcv")
    command("denoise shot/diffuse.0001.exr -m wcv -o b.png")
    assert Path("1.png").read_bytes() == Path("b.png").read_bytes()
    # What is left of a shot, and of each frame.
    Path("clean/diffuse.0001.exr").unlink()
    assert "1 of 2 frames were skipped" in command(clean)
    command(f"{clean} --spp 8")
    for frame in range(2):
        found = header(f"clean/diffuse.000{frame}.exr")
        assert found["ngpt:spp"] == 8 and found["ngpt:method"] == "wcv" and len(found["ngpt:seed"].split()) == 2
    # Stacks are no images.
    assert "it is a stack" in command(f"{words} -o shot --denoise --skip-existing", 1)
