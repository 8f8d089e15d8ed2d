"""The commands: what they write, what they say, what their exit status means."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import ngpt
from ngpt.cli import main


@pytest.fixture
def stack_file(tmp_path, noisy_stack):
    """Writes the noisy stack under a name, and returns its path."""
    stack, clean = noisy_stack

    def write(name="s.exr", **layers):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True, parents=True)
        ngpt.write(path, stack.replace(**layers))
        ngpt.write(path.with_name("clean.png.exr"), clean, overwrite=True)
        return str(path)

    return write


def test_denoise_one_file(tmp_path, stack_file, capsys):
    source, target = stack_file(), tmp_path / "out.exr"
    assert main(["denoise", source, "-o", str(target), "--method", "l2"]) == 0
    assert np.array_equal(ngpt.read_image(target), ngpt.denoise(ngpt.read(source), "l2"))
    assert np.array_equal(ngpt.read(target)["primal"], ngpt.read(source)["primal"])  # nothing is lost
    assert "l2" in capsys.readouterr().err


def test_denoise_reports_as_json(tmp_path, stack_file, capsys):
    primal = ngpt.read(stack_file("x.exr"))["primal"].copy()
    primal[2, 3] = np.nan
    source = stack_file("y.exr", primal=primal)
    reference = str(tmp_path / "clean.png.exr")
    assert main(["denoise", source, "--method", "l1", "--alpha", "0.3", "--ref", reference, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (file,) = report["files"]
    assert report["ok"] and file["method"] == "l1" and file["repaired"] == 1 and file["untrusted"] == 4
    assert file["output"].endswith("y_denoised.exr") and os.path.exists(file["output"])
    assert 0 < file["metrics"]["relMSE"] < 0.01


def test_denoise_folders_and_patterns(tmp_path, stack_file):
    for name in ("a/1.exr", "a/2.exr", "b/3.exr"):
        stack_file(name)
    for path in tmp_path.rglob("clean*"):
        path.unlink()
    out = tmp_path / "out"
    assert main(["denoise", str(tmp_path / "a"), str(tmp_path / "b" / "*.exr"), "-o", str(out), "-q"]) == 0
    assert sorted(os.listdir(out)) == ["1.exr", "2.exr", "3.exr"]
    # Results beside their stacks are not taken for stacks the next time.
    assert main(["denoise", str(tmp_path / "a"), "-q"]) == 0
    assert main(["denoise", str(tmp_path / "a"), "-q", "--force"]) == 0
    assert sorted(os.listdir(tmp_path / "a")) == ["1.exr", "1_denoised.exr", "2.exr", "2_denoised.exr"]


def test_denoise_does_what_it_can_and_says_what_it_could_not(tmp_path, stack_file, capsys):
    good, bad = stack_file("good.exr"), tmp_path / "bad.exr"
    bad.write_bytes(b"not an image")
    out = tmp_path / "out"
    assert main(["denoise", good, str(bad), "-o", str(out), "--json"]) == 1
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert not report["ok"] and "not an OpenEXR file" in report["files"][1]["error"]
    assert os.listdir(out) == ["good.exr"]
    assert "1 of 2 stacks were not reconstructed" in captured.err


def test_layers_by_other_names(tmp_path, noisy_stack):
    stack, _ = noisy_stack
    from ngpt.io.exr import ExrImage, ExrPart, write_exr

    channels = {}
    for prefix, name in (("noisy.", "primal"), ("gx.", "dx"), ("gy.", "dy")):
        channels |= {f"{prefix}{c}": stack[name][..., i].copy() for i, c in enumerate("RGB")}
    source, target = tmp_path / "s.exr", tmp_path / "out.exr"
    write_exr(source, ExrImage([ExrPart("", {}, channels)]))
    layers = ["--layer", "primal=noisy", "--layer", "dx=gx", "--layer", "dy=gy"]
    assert main(["denoise", str(source), "-o", str(target), "--method", "l2", "-q", *layers]) == 0
    assert np.array_equal(ngpt.read_image(target), ngpt.denoise(stack, "l2"))


def test_diff_says_whether_images_agree(tmp_path, rng, capsys):
    image = rng.random((6, 5, 3)).astype(np.float32)
    a, b = str(ngpt.write(tmp_path / "a.exr", image)), str(ngpt.write(tmp_path / "b.exr", image + 0.1))
    assert main(["diff", a, a]) == 0
    assert "agree" in capsys.readouterr().out
    assert main(["diff", a, b, "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert not report["agree"] and report["metrics"]["MSE"] == pytest.approx(0.01, rel=1e-4)
    assert main(["diff", a, b, "--tolerance", "100"]) == 0
    image[0, 0] = np.nan
    c = str(ngpt.write(tmp_path / "c.exr", image))
    assert main(["diff", c, a]) == 1  # where they can be compared they are equal, but they do not agree


def test_diff_tells_what_the_eye_sees_where_the_packages_are(tmp_path, rng, capsys, monkeypatch):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    image = rng.random((16, 15, 3)).astype(np.float32)
    a, b = str(ngpt.write(tmp_path / "a.exr", image)), str(ngpt.write(tmp_path / "b.exr", image + 0.1))
    assert main(["diff", a, b, "--json"]) == 1
    metrics = json.loads(capsys.readouterr().out)["metrics"]
    assert 0 < metrics["SSIM"] < 1 and 0 < metrics["FLIP"] < 1
    monkeypatch.setattr("ngpt.measure.perceptual.find_spec", lambda name: None)
    assert main(["diff", a, b]) == 1
    output, errors = capsys.readouterr()
    assert "SSIM" not in output and errors == "without SSIM and FLIP: --verbose says why\n"
    assert main(["diff", a, b, "-v"]) == 1
    errors = capsys.readouterr().err
    assert "SSIM needs scikit-image" in errors and "FLIP needs flip-evaluator" in errors


def test_info_on_a_file(stack_file, capsys):
    assert main(["info", stack_file(albedo=np.full((17, 24, 3), 0.25)), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["size"] == [24, 17] and report["layers"]["albedo"]["mean"] == 0.25
    assert report["methods"] == ["primal", "l2", "l1"] or set(report["methods"]) >= {"primal", "l2", "l1"}
    assert report["auto"] in report["methods"] and report["auto"] != "primal"
    assert "depth" in report["missing"]
    assert main(["info", stack_file("t.exr")]) == 0
    assert "channels dx.R dx.G dx.B" in capsys.readouterr().out


def imported_by(code, *arguments):
    """The packages that take long to import, of those that a program has imported in the end."""
    slow = "{'torch', 'mitsuba', 'drjit', 'skimage', 'scipy', 'rich', 'data_gen.samplers.photons.integrator'}"
    code = f"import sys\n{code}\nprint(*sorted({slow} & set(sys.modules)), sep=',')"
    run = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()


RUN = "from ngpt.cli import main; assert main(sys.argv[1:]) == 0"


@pytest.mark.parametrize("method", ["oidn", "nfor", "l1"])
def test_denoising_imports_neither_torch_nor_mitsuba(stack_file, method):
    """Nor SciPy, which takes a quarter of a second, unless the method works by it."""
    names = imported_by(RUN, "denoise", stack_file(), "-q", "-m", method)
    assert names == (["scipy"] if method in ("nfor", "l1") else [])


def test_a_render_imports_its_own_sampler_alone(renderer, tmp_path):
    words = ["render", "diffuse", "--size", "16x12", "--spp", "2", "--sampler", "gpt", "-q"]
    for name in ("it.exr", "it.png"):
        assert imported_by(RUN, *words, "-o", str(tmp_path / name)) == ["drjit,mitsuba"]


def test_render_denoise_diff(renderer, tmp_path, capsys):
    stack, ref, out = (str(tmp_path / name) for name in ("s.exr", "ref.exr", "out.exr"))
    assert main(["render", "diffuse", "-o", stack, "--spp", "16", "--size", "128x96", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["layers"][:4] == ["primal", "direct", "dx", "dy"]
    # No terminal here: plain lines, first and last among them.
    assert "render diffuse: 0/16 spp" in captured.err and "render diffuse: 16/16 spp" in captured.err
    assert main(["render", "diffuse", "-o", ref, "--spp", "512", "--sampler", "primal", "--size", "128x96", "-q"]) == 0
    assert main(["denoise", stack, "-o", out, "--method", "l1", "-q"]) == 0
    errors = []
    for image in (stack, out):
        assert main(["diff", image, ref, "--json"]) == 1
        errors.append(json.loads(capsys.readouterr().out)["metrics"]["relMSE"])
    assert errors[1] < errors[0] / 3


def test_lines_of_progress_tell_the_time_left(capsys, monkeypatch):
    import ngpt.system.console as console

    clock = iter((100.0, 108.0, 130.0))
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.Console().progress("render", "spp") as update:
        for done in (0, 25, 100):
            update(done, 100)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["render: 0/100 spp", "render: 25/100 spp, 8.0 s, about 24 s left", "render: 100/100 spp, 30.0 s"]


def test_what_lay_ready_says_nothing_about_the_time_left(capsys, monkeypatch):
    """500 of 1000 were done before; 100 more come out of a cache at once; then each takes a second."""
    import ngpt.system.console as console

    clock = iter((0.0, 1.0, 21.0, 41.0, 341.0, 344.0, 352.0))
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.Console().progress("evaluate", "cells", rate=True) as update:
        for done in (500, 600, 620, 640, 940, 943, 1000):
            update(done, 1000)
    assert capsys.readouterr().err.splitlines() == [
        "evaluate: 500/1000 cells",
        "evaluate: 620/1000 cells, 21.0 s, 1 cells/s, about 6 min left",
        "evaluate: 640/1000 cells, 41.0 s, 1 cells/s, about 6 min left",
        "evaluate: 940/1000 cells, 341.0 s, 1 cells/s, about 60 s left",
        "evaluate: 1000/1000 cells, 352.0 s, 1.16 cells/s",
    ]


@pytest.mark.parametrize("presses", [1, 2])
def test_ctrl_c_keeps_what_was_rendered_and_twice_discards_it(renderer, tmp_path, presses):
    # In a process of its own, with a sampler that presses the keys once the first pass is done.
    code = (
        "import data_gen.passes as c, os, signal, sys, time\n"
        "def end_pass(film, *block):\n"
        "    presses = int(sys.argv[1]) if film._pass else 0\n"
        "    old(film, *block)\n"
        # Any thread may get a signal, at its leisure, and two that are pending count as one.
        "    for _ in range(presses): os.kill(os.getpid(), signal.SIGINT); time.sleep(0.5)\n"
        "old, c.GradientFilm.end_pass = c.GradientFilm.end_pass, end_pass\n"
        # Whoever started the tests in the background had Ctrl-C ignored by everything in them.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from ngpt.cli import main; sys.exit(main(sys.argv[2:]))"
    )
    code = f"from data_gen.backend import use_variant; use_variant()\n{code}"
    target = tmp_path / "s.exr"
    arguments = ["render", "diffuse", "-o", str(target), "--size", "8x8", "--spp", "100000000", "--sampler", "primal"]
    run = subprocess.run([sys.executable, "-c", code, str(presses), *arguments], capture_output=True, text=True)
    assert run.returncode == 130, run.stderr
    assert "a second signal, discards it all" in run.stderr and "Traceback" not in run.stderr
    if presses == 1:
        spp = ngpt.read(target).attributes["ngpt:spp"]
        assert spp > 1 and f"holds the {spp} samples per pixel done by then" in run.stderr
    else:
        assert os.listdir(tmp_path) == [] and "error: interrupted" in run.stderr


def test_rendering_without_llvm_says_what_to_install(tmp_path):
    # In a process of its own: this one has loaded the library already.
    code = "import data_gen.llvm as l, sys; l._PATTERNS = (); from ngpt.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    run = subprocess.run(
        [sys.executable, "-c", code, "render", "diffuse", "-o", str(tmp_path / "s.exr")],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert run.returncode == 1 and os.listdir(tmp_path) == []
    assert "libllvm19" in run.stderr and run.stderr.count("\n") == 1


def test_demo(renderer, tmp_path, capsys):
    folder = tmp_path / "demo"
    arguments = ["demo", "-o", str(folder), "--scene", "diffuse", "--spp", "16", "--reference-spp", "256"]
    assert main([*arguments, "--size", "48x32", "-q"]) == 0
    written = {path.name for path in folder.iterdir()}
    assert {"report.html", "diffuse_stack.exr", "diffuse_ref.exr", "diffuse_l1.exr", "diffuse_l2.exr"} <= written
    assert "diffuse_nlm.exr" not in written  # a study
    html = (folder / "report.html").read_text()
    assert "diffuse" in html and "relMSE" in html
    rows = {line.split()[1]: float(line.split()[2]) for line in capsys.readouterr().out.splitlines()[1:]}
    assert rows["l1"] < rows["primal"] / 3
    assert main([*arguments, "-q"]) == 1  # the report is there already


def test_ctrl_c_is_ignored_where_whoever_started_it_said_so():
    from data_gen.session import stop_on_ctrl_c

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stop_on_ctrl_c() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            assert not stop()
    finally:
        signal.signal(signal.SIGINT, before)
