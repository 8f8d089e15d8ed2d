"""``ngpt render --denoise``, and pictures of a render: the image that `ngpt denoise` would make, by one command."""

import io
import sys
from contextlib import contextmanager

import numpy as np
import pytest

import ngpt
from data_gen import begun
from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.io.exr import read_exr
from ngpt.methods import METHODS
from ngpt.report import pictures, transforms
from ngpt.system.interrupts import Interrupt

SIZE = ["--size", "16x12", "--sampler", "gpt", "-q"]


def channels(path):
    (part,) = read_exr(path).parts
    return part.channels


def same(one, other):
    """Whether two files hold the same, bit for bit, but for the times that it took."""
    a, b = ({k: v for k, v in read_exr(path).parts[0].header.items() if "econds" not in k} for path in (one, other))
    ours = {k: str(v) for k, v in a.items() if k != "channels"} == {k: str(v) for k, v in b.items() if k != "channels"}
    one, other = channels(one), channels(other)
    return ours and one.keys() == other.keys() and all(np.array_equal(one[k], other[k], equal_nan=True) for k in one)


@pytest.mark.parametrize("more", [["--spp", "4"], ["--spp", "48", "--adaptive", "--for", "wcv", "--diagnostics"]])
def test_the_image_is_that_of_two_commands(renderer, tmp_path, more):
    stack, two, one, kept = (str(tmp_path / f"{name}.exr") for name in ("stack", "two", "one", "kept"))
    words = ["render", "diffuse", *SIZE, *more]
    method = ["-m", "wcv"] if "--for" in more else []
    assert main([*words, "-o", stack]) == 0 and main(["denoise", stack, "-o", two, "-q", *method]) == 0
    assert main([*words, "-o", one, "--denoise", "--keep", kept]) == 0
    assert same(two, one) and same(stack, kept)
    assert read_exr(one).parts[0].header["ngpt:method"] == ("wcv" if method else "ngpt-combine")
    for kind in ("png", "pfm"):
        look = ["--transform", "filmic", "--exposure", "1.5"]
        assert main([*words, "-o", f"{one}.{kind}", *look]) == 0
        assert main(["denoise", stack, "-o", f"{two}.{kind}", "-q", *look, *method]) == 0
        assert (tmp_path / f"one.exr.{kind}").read_bytes() == (tmp_path / f"two.exr.{kind}").read_bytes()


def test_a_method_goes_before_the_one_that_samples_are_shared_for(renderer, tmp_path):
    out = str(tmp_path / "it.exr")
    assert main(["render", "diffuse", *SIZE, "--adaptive", "--for", "wcv", "--denoise", "l1", "-o", out]) == 0
    header = read_exr(out).parts[0].header
    assert header["ngpt:method"] == "l1" and header["ngpt:adaptive"] == "wcv"


def test_the_memory_of_a_render_is_free_before_a_method_runs(renderer, tmp_path, monkeypatch):
    import drjit as dr

    from data_gen import outputs

    order, real = [], outputs.reconstruct
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: order.append("freed"))
    monkeypatch.setattr(outputs, "reconstruct", lambda *args: order.append("denoised") or real(*args))
    assert main(["render", "diffuse", *SIZE, "--spp", "2", "--denoise", "l1", "-o", str(tmp_path / "it.png")]) == 0
    assert order == ["freed", "denoised"]


def test_the_error_to_reach_is_that_of_the_image(renderer, tmp_path, capsys):
    words = ["render", "diffuse", *SIZE[:-1], "--error", "0.9", "--spp", "32", "--denoise", "wcv"]
    assert main([*words, "-o", str(tmp_path / "it.png")]) == 0
    assert "'wcv' is expected to have an error of" in capsys.readouterr().err


def test_the_method_of_a_pilot_is_run(renderer, tmp_path, monkeypatch, capsys):
    from data_gen.choosing import plans

    monkeypatch.setattr(plans, "plan", lambda *_, **__: plans.Plan("primal", "nfor", False, 0.5, "for a test"))
    out = str(tmp_path / "it.exr")
    assert main(["render", "diffuse", "--size", "16x12", "--time", "9", "--for", "auto", "--denoise", "-o", out]) == 0
    assert read_exr(out).parts[0].header["ngpt:method"] == "nfor"
    said = capsys.readouterr().err
    assert " s, nfor " in said and "then: ngpt denoise" not in said


def test_the_error_of_what_goes_on_is_that_of_its_method(renderer, tmp_path, monkeypatch, capsys):
    from data_gen.choosing import plans

    monkeypatch.setattr(plans, "plan_sampler", lambda *_, **__: plans.Plan("primal", "nfor", False, None, "for a test"))
    words = ["render", "diffuse", "--size", "16x12", "-o", str(tmp_path / "it.exr")]
    assert main([*words, "--spp", "4"]) == 0
    assert main([*words, "--error", "0.5", "--skip-existing"]) == 0
    said = capsys.readouterr().err
    assert "'nfor' is expected to have an error" in said and "which takes method 'nfor'" in said


def test_the_line_on_what_comes_next_names_the_method_that_it_takes(renderer, tmp_path, monkeypatch, capsys):
    """One sample per pixel has no variances, so not every method that a render is for can clean it."""
    from data_gen.choosing import plans

    monkeypatch.setattr(plans, "plan_sampler", lambda *_, **__: plans.Plan("gpt", "wcv", False, None, "for a test"))
    for spp, taken in (("1", None), ("2", "wcv")):
        out = str(tmp_path / f"{spp}.exr")
        assert main(["render", "diffuse", "--size", "16x12", "--spp", spp, "-o", out]) == 0
        said = capsys.readouterr().err
        assert main(["denoise", out, "-o", str(tmp_path / "image.exr"), "-q"]) == 0
        method = read_exr(tmp_path / "image.exr").parts[0].header["ngpt:method"]
        assert f"which takes method '{method}'" in said and (method == taken if taken else method != "wcv")
        (tmp_path / "image.exr").unlink()


@pytest.mark.parametrize(
    ("frames", "more"),
    [
        ([], ["--spp", "4", "--denoise", "wcv"]),
        (["--frames", "0:1"], ["--spp", "4", "--denoise", "wcv"]),
        ([], ["--time", "60", "--for", "wcv"]),
    ],
)
def test_a_method_that_cannot_use_what_was_begun_is_refused(renderer, tmp_path, monkeypatch, capsys, frames, more):
    from data_gen import render
    from data_gen.frames import shot

    out = str(tmp_path / ("{frame}.exr" if frames else "0.exr"))
    words = ["render", "diffuse", "--size", "16x12", "-o", out, *frames]
    assert main([*words, "--spp", "2", "--sampler", "primal"]) == 0
    monkeypatch.setattr(render, "render_stack", lambda *_, **__: pytest.fail("rendered"))
    monkeypatch.setattr(shot, "render_shot", lambda *_, **__: pytest.fail("rendered"))
    assert main([*words, "--skip-existing", *more]) == 2
    assert "0.exr renders none" in capsys.readouterr().err


@pytest.mark.parametrize("kept", [False, True])
def test_a_render_goes_on_and_its_image_is_made_anew(renderer, tmp_path, capsys, kept):
    """From the result, which has the stack in it, or from the stack that is kept beside a picture."""
    stack, target = tmp_path / "stack.exr", tmp_path / ("it.png" if kept else "it.exr")
    words = ["render", "diffuse", *SIZE[:-1], "--seed", "3", "--diagnostics"]
    one = [*words, "--skip-existing", "--denoise", "wcv", "-o", str(target), *(["--keep", str(stack)] if kept else [])]
    assert main([*one, "--spp", "16"]) == 0
    first = target.read_bytes()
    assert main([*one, "--spp", "48"]) == 0
    assert "has 16 samples per pixel; going on with it" in capsys.readouterr().err and target.read_bytes() != first
    plain = tmp_path / "plain.exr"
    for spp in ("16", "48"):
        assert main([*words, "--skip-existing", "-o", str(plain), "--spp", spp, "-q"]) == 0
    again = tmp_path / f"again{target.suffix}"
    assert main(["denoise", str(plain), "-m", "wcv", "-o", str(again), "-q"]) == 0
    assert same(stack, plain) and target.read_bytes() == again.read_bytes() if kept else same(target, again)
    before = target.read_bytes()
    capsys.readouterr()
    assert main([*one, "--spp", "48"]) == 0 and "the image is there" in capsys.readouterr().err
    assert target.read_bytes() == before
    if kept:
        target.unlink()
        assert main([*one, "--spp", "48"]) == 0 and "the stack was there" in capsys.readouterr().err
        assert target.read_bytes() == before
    else:
        # A stack is no image, and a result holds its stack.
        assert main([*one[:-1], str(plain), "--spp", "48"]) == 1 and "it is a stack" in capsys.readouterr().err
        assert main([*words, "--skip-existing", "-o", str(target), "--spp", "64", "-q"]) == 0
        assert "ngpt:method" not in read_exr(target).parts[0].header and "primal.R" not in channels(target)
        assert ngpt.read(target).attributes["ngpt:spp"] == 64


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.exr", "--denoise", "wcvv"], "invalid choice: 'wcvv'"),
        (
            ["-o", "a.png", "--denoise", "wcv", "--sampler", "primal"],
            "needs gradients, and sampler 'primal' renders none",
        ),
        (
            ["-o", "a.png", "--denoise", "wcv", "--sampler", "restir", "--frames", "0:2"],
            "sampler 'restir' renders none",
        ),
        (["-o", "a.png", "--denoise", "ngpt-primal", "--spp", "1"], "needs variances"),
        (["-o", "a.png", "--denoise", "nlm"], "method 'nlm' cannot be used: none here; name another"),
        (["-o", "a.png", "--transform", "aces"], "--transform aces needs OpenColorIO"),
        (["-o", "a.tga"], "stacks are OpenEXR; let the name end in .exr, or for an image in .png"),
        (["-o", "a.tga", "--denoise"], "results are OpenEXR, PFM or pictures"),
        (["-o", "there.png"], "there.png: exists already; pass --force (overwrite=True) to replace it\n"),
        (["-o", "a.png", "--keep", "there.exr"], "there.exr: exists already; pass --force"),
        (["-o", "a.png", "--keep", "b.png"], "b.png: stacks are OpenEXR"),
        (["-o", "a.exr", "--keep", "b.exr"], "the output is the stack; add --denoise"),
        (["-o", "a.exr", "--denoise", "--keep", "./a.exr"], "--keep a.exr: is the file of the image"),
        (["-o", "a.png", "--frames", "0:2"], "is one file for 2 frames; write -o 'a.{frame:04d}.png'"),
        (["-o", "a.png", "--skip-existing"], "keep the stack too: --keep FILE.exr"),
        (["-o", "{frame}.png", "--frames", "0:2", "--skip-existing"], "keep the stack too"),
        (["-o", "{frame}.png", "--frames", "0:2", "--keep", "b.exr"], "--keep is for single images"),
        (["-o", "{frame}.tga", "--frames", "0:2"], "stacks are OpenEXR"),
        (["-o", "-", "--frames", "0:2"], "standard output is one file for several frames"),
        (["-o", "-", "--json"], "--json also wants standard output"),
    ],
)
def test_what_would_fail_afterwards_is_refused_before(renderer, tmp_path, monkeypatch, capsys, words, message):
    from dataclasses import replace

    from data_gen import render
    from data_gen.frames import shot

    monkeypatch.setattr(render, "render_stack", lambda *_, **__: pytest.fail("rendered"))
    monkeypatch.setattr(shot, "render_shot", lambda *_, **__: pytest.fail("rendered"))
    monkeypatch.setitem(METHODS, "nlm", replace(METHODS["nlm"], missing=lambda: "none here"))
    monkeypatch.setattr(transforms, "find_spec", lambda name: None)
    transforms._aces.cache_clear()
    monkeypatch.chdir(tmp_path)
    for name in ("there.png", "there.exr"):
        (tmp_path / name).write_text("precious")
    try:
        status = main(["render", "diffuse", *words])
    except SystemExit as error:
        status = error.code
    printed = capsys.readouterr().err
    assert status in (1, 2) and message in printed and len(printed.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there.exr", "there.png"]


def test_a_sampler_that_a_pilot_takes_is_judged_before_its_render(renderer, tmp_path, monkeypatch, capsys):
    from data_gen import render
    from data_gen.choosing import plans

    monkeypatch.setattr(plans, "plan_sampler", lambda *_, **__: plans.Plan("primal", "", False, None, "for a test"))
    monkeypatch.setattr(render, "render_stack", lambda *_, **__: pytest.fail("rendered"))
    assert main(["render", "diffuse", "--size", "8x8", "--denoise", "wcv", "-o", str(tmp_path / "a.png")]) == 2
    assert "sampler 'primal' renders none" in capsys.readouterr().err


def test_a_method_that_fails_loses_no_sample(renderer, tmp_path, monkeypatch, capsys):
    from data_gen import outputs

    def fails(stack, method):
        raise NgptError("no luck")

    monkeypatch.setattr(outputs, "reconstruct", fails)
    words = ["render", "diffuse", *SIZE[:-1], "--spp", "4", "-o", str(tmp_path / "it.png")]
    assert main(words) == 1
    assert f"no luck; what was rendered is in {tmp_path / 'it.stack.exr'}" in capsys.readouterr().err
    assert ngpt.read(tmp_path / "it.stack.exr").attributes["ngpt:spp"] == 4 and not (tmp_path / "it.png").exists()
    assert main([*words, "--keep", str(tmp_path / "kept.exr")]) == 1
    assert "what was rendered" not in capsys.readouterr().err and (tmp_path / "kept.exr").exists()


@pytest.mark.parametrize("error", [NgptError("no luck"), MemoryError(), ValueError("shapes")])
def test_what_a_failed_method_leaves_outlives_standard_output_and_takes_a_free_name(
    renderer, tmp_path, monkeypatch, capsys, error
):
    from data_gen import outputs

    def fails(stack, method):
        raise error

    monkeypatch.setattr(outputs, "reconstruct", fails)
    monkeypatch.chdir(tmp_path)
    words = ["render", "diffuse", *SIZE, "--spp", "4", "--denoise", "-o"]
    why = "no luck"
    if not isinstance(error, NgptError):
        why = f"method 'auto' failed: {type(error).__name__}" + (f": {error}" if str(error) else "")
    assert main([*words, "-"]) == 1
    assert f"{why}; what was rendered is in standard-output.stack.exr" in capsys.readouterr().err
    assert ngpt.read("standard-output.stack.exr").attributes["ngpt:spp"] == 4
    (tmp_path / "it.stack.exr").write_text("precious")
    assert main([*words, "it.exr"]) == 1
    printed = capsys.readouterr().err
    assert f"error: {why}; it.stack.exr: exists already" in printed and "is kept in it.stack.kept.exr" in printed
    assert (tmp_path / "it.stack.exr").read_text() == "precious"
    assert ngpt.read("it.stack.kept.exr").attributes["ngpt:spp"] == 4


def test_a_render_too_wide_for_its_picture_is_kept(renderer, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(pictures._LONGEST, ".png", 15)
    monkeypatch.chdir(tmp_path)
    assert main(["render", "diffuse", *SIZE, "--spp", "2", "-o", "it.png"]) == 1
    assert "16x12 pixels are too many for .png" in (said := capsys.readouterr().err) and said.count("\n") == 1
    assert ngpt.read("it.stack.exr").attributes["ngpt:spp"] == 2 and not (tmp_path / "it.png").exists()


def test_a_picture_that_is_older_than_its_stack_is_made_anew(renderer, tmp_path, capsys):
    """The stack may have grown by itself, or the process may have ended between both."""
    words = ["render", "diffuse", *SIZE[:-1], "--skip-existing", "-o"]
    stack, picture = str(tmp_path / "stack.exr"), tmp_path / "it.png"
    both = [*words, str(picture), "--keep", stack, "--denoise", "l1"]
    assert main([*both, "--spp", "2"]) == 0
    before = picture.read_bytes()
    assert main([*words, stack, "--spp", "8"]) == 0
    capsys.readouterr()
    assert main([*both, "--spp", "8"]) == 0 and "the stack was there" in capsys.readouterr().err
    assert picture.read_bytes() != before
    assert main([*both, "--spp", "8"]) == 0 and "the image is there" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["it.png", "it.exr"])
def test_an_interrupted_render_gives_its_image(renderer, tmp_path, monkeypatch, capsys, name):
    from data_gen import passes
    from data_gen.cli import render

    monkeypatch.setattr(passes, "FIRST_LANES", 16 * 12 * 16)  # several passes
    pressed = Interrupt()
    pressed.signal = 2
    monkeypatch.setattr(render, "stop_on_ctrl_c", contextmanager(lambda told: iter([pressed])))
    out = tmp_path / name
    assert main(["render", "diffuse", *SIZE, "--spp", "64", "--denoise", "-o", str(out)]) == 130
    assert f"{out} holds the 16 samples per pixel done by then" in capsys.readouterr().err and out.exists()
    if out.suffix == ".exr":
        assert begun.rendered(ngpt.read(out)).attributes["ngpt:unfinished"] == "interrupted"


def test_standard_output_gets_a_stack_or_its_image(renderer, tmp_path, monkeypatch):
    class Binary:
        def __init__(self):
            self.buffer, self.errors = io.BytesIO(), "strict"

        isatty, flush = (lambda self: False), (lambda self: None)

    words = ["render", "diffuse", *SIZE, "--spp", "4", "-o"]
    for more in ([], ["--denoise", "wcv"]):
        with monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", Binary())
            assert main([*words, "-", *more]) == 0
            (tmp_path / "piped.exr").write_bytes(sys.stdout.buffer.getvalue())
        assert main([*words, str(tmp_path / "it.exr"), *more, "--force"]) == 0
        assert same(tmp_path / "piped.exr", tmp_path / "it.exr")


def test_frames_are_denoised_one_by_one(renderer, tmp_path, capsys):
    words = ["render", "diffuse", "--frames", "0:2", *SIZE[:-1], "-o"]
    clean = [*words, str(tmp_path / "clean"), "--denoise", "wcv", "--skip-existing"]
    assert main([*clean, "--spp", "4"]) == 0 and " s, wcv " in capsys.readouterr().err
    assert main([*words, str(tmp_path / "shot"), "--spp", "4"]) == 0
    assert main(["denoise", str(tmp_path / "shot"), "-o", str(tmp_path / "two"), "-m", "wcv"]) == 0
    for name in ("diffuse.0000.exr", "diffuse.0001.exr"):
        assert same(tmp_path / "clean" / name, tmp_path / "two" / name)
    assert main([*words, str(tmp_path / "{frame}.png"), "--spp", "4", "--denoise", "wcv"]) == 0
    assert main(["denoise", str(tmp_path / "shot/diffuse.0001.exr"), "-m", "wcv", "-o", str(tmp_path / "b.png")]) == 0
    assert (tmp_path / "1.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    # What is left of a shot, and of each frame.
    (tmp_path / "clean/diffuse.0001.exr").unlink()
    capsys.readouterr()
    assert main([*clean, "--spp", "4"]) == 0 and "1 of 2 frames were skipped" in capsys.readouterr().err
    assert main([*clean, "--spp", "8"]) == 0
    for frame in range(2):
        header = read_exr(tmp_path / f"clean/diffuse.000{frame}.exr").parts[0].header
        assert header["ngpt:spp"] == 8 and header["ngpt:method"] == "wcv" and len(header["ngpt:seed"].split()) == 2
    # Stacks are no images.
    assert main([*words, str(tmp_path / "shot"), "--denoise", "--skip-existing", "--spp", "4"]) == 1
    assert "it is a stack" in capsys.readouterr().err
