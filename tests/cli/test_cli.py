"""The commands: what they write, what they say, what their exit status means."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import ngpt


@pytest.fixture
def stack_file(tmp_path, noisy_stack):
    """Writes the noisy stack, some layers replaced, and beside it what has no noise."""
    stack, clean = noisy_stack

    def write(name="s.exr", **layers):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        ngpt.write(tmp_path / name, stack.replace(**layers))
        ngpt.write(tmp_path / "clean.exr", clean, overwrite=True)

    return write


def test_denoise_reports_as_json_and_loses_nothing(stack_file, noisy_stack, command):
    primal = noisy_stack[0]["primal"].copy()
    primal[2, 3] = np.nan
    stack_file("y.exr", primal=primal)
    report = json.loads(command("denoise y.exr --method l1 --alpha 0.3 --ref clean.exr --json").out)
    (file,) = report["files"]
    assert report["ok"] and file["method"] == "l1" and file["repaired"] == 1 and file["untrusted"] == 4
    assert file["output"] == "y_denoised.exr" and 0 < file["metrics"]["relMSE"] < 0.01
    assert np.array_equal(ngpt.read_image("y_denoised.exr"), ngpt.denoise(ngpt.read("y.exr"), "l1", alpha=0.3))
    assert np.array_equal(ngpt.read("y_denoised.exr")["primal"], primal, equal_nan=True)


def test_diff_says_whether_images_agree(tmp_path, rng, command):
    image = rng.random((6, 5, 3)).astype(np.float32)
    spoilt = image.copy()
    spoilt[0, 0] = np.nan
    for name, pixels in (("a", image), ("b", image + 0.1), ("c", spoilt)):
        ngpt.write(tmp_path / f"{name}.exr", pixels)
    assert "agree" in command("diff a.exr a.exr").out
    report = json.loads(command("diff a.exr b.exr --json", 1).out)
    assert not report["agree"] and report["metrics"]["MSE"] == pytest.approx(0.01, rel=1e-4)
    command("diff a.exr b.exr --tolerance 100")
    command("diff c.exr a.exr", 1)  # where they can be compared they are equal, but they do not agree


def test_diff_tells_what_the_eye_sees_where_the_packages_are(tmp_path, rng, command, monkeypatch):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    image = rng.random((16, 15, 3)).astype(np.float32)
    for name, pixels in (("a", image), ("b", image + 0.1)):
        ngpt.write(tmp_path / f"{name}.exr", pixels)
    metrics = json.loads(command("diff a.exr b.exr --json", 1).out)["metrics"]
    assert 0 < metrics["SSIM"] < 1 and 0 < metrics["FLIP"] < 1
    monkeypatch.setattr("ngpt.measure.perceptual.find_spec", lambda name: None)
    output, errors = command("diff a.exr b.exr", 1)
    assert "SSIM" not in output and errors == "without SSIM and FLIP: --verbose says why\n"
    errors = command("diff a.exr b.exr -v", 1).err
    assert "SSIM needs scikit-image" in errors and "FLIP needs flip-evaluator" in errors


def test_info_on_a_file(stack_file, command):
    stack_file(albedo=np.full((17, 24, 3), 0.25))
    report = json.loads(command("info s.exr --json").out)
    assert report["size"] == [24, 17] and report["layers"]["albedo"]["mean"] == 0.25
    assert set(report["methods"]) >= {"primal", "l2", "l1", report["auto"]} and report["auto"] != "primal"
    assert "depth" in report["missing"] and "channels dx.R dx.G dx.B" in command("info s.exr").out


def test_info_prints_no_long_attribute_as_a_whole(stack_file, noisy_stack, tmp_path, command):
    """Manifests of Cryptomatte have a million letters."""
    noisy_stack[0].attributes["cryptomatte/0/manifest"] = manifest = "{" + 1000 * "letters" + "}"
    stack_file()
    (line,) = (line for line in command("info s.exr").out.splitlines() if "manifest" in line)
    assert manifest[:100] in line and len(line) < 300 and "(7002 letters; --json prints all)" in line
    assert json.loads(command("info s.exr --json").out)["attributes"]["cryptomatte/0/manifest"] == manifest


def imported_by(folder, *lines):
    """The packages that take long to import, of those that commands have imported in the end."""
    slow = "{'torch', 'mitsuba', 'drjit', 'skimage', 'scipy', 'rich', 'data_gen.samplers.photons.integrator'}"
    code = "import sys; from ngpt.cli import main; assert not any(main(line.split()) for line in sys.argv[1:]); "
    code += f"print(*sorted({slow} & set(sys.modules)), sep=',')"
    run = subprocess.run([sys.executable, "-c", code, *lines], capture_output=True, text=True, cwd=folder)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()


@pytest.mark.parametrize(
    ("methods", "expected"), [(["primal", "oidn"], []), (["l2", "l1", "cv", "wcv", "wl2", "nfor"], ["scipy"])]
)
def test_denoising_imports_neither_torch_nor_mitsuba(stack_file, noisy_stack, tmp_path, methods, expected):
    """Nor SciPy, which takes a quarter of a second, unless a method works by it."""
    variances = {f"{name}_var": np.full_like(noisy_stack[0][name], 0.01) for name in ("primal", "dx", "dy")}
    stack_file(**variances)
    lines = [f"denoise s.exr -q --force -m {method}" for method in methods]
    assert imported_by(tmp_path, *lines) == expected


def test_render_tells_what_it_does_and_what_it_made(renderer, command):
    output, errors = command("render diffuse -o s.exr --spp 4 --size 16x12 --sampler gpt --json")
    assert json.loads(output)["layers"][:4] == ["primal", "direct", "dx", "dy"]
    # No terminal here: plain lines, first and last among them.
    assert "render diffuse: 0/4 spp" in errors and "render diffuse: 4/4 spp" in errors


def test_lines_of_progress_tell_the_time_left_and_leave_what_lay_ready_out(capsys, monkeypatch):
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


def in_a_process(code, line, **options):
    """A command in a process of its own, in which ``code`` runs before."""
    code = f"import sys\n{code}\nfrom ngpt.cli import main\nsys.exit(main(sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", code, *line.split()], capture_output=True, text=True, **options)


def test_ctrl_c_twice_discards_what_was_rendered(renderer, tmp_path):
    """By a sampler that presses the keys once the first pass is done. Once keeps it: robustness/test_interrupts.py."""
    code = (
        "from data_gen.backend import use_variant; use_variant()\n"
        "import data_gen.passes as c, os, signal, time\n"
        "def end_pass(film, *block):\n"
        "    old(film, *block)\n"
        # Any thread may get a signal, at its leisure, and two that are pending count as one.
        "    for _ in range(2): os.kill(os.getpid(), signal.SIGINT); time.sleep(0.5)\n"
        "old, c.GradientFilm.end_pass = c.GradientFilm.end_pass, end_pass\n"
        # Whoever started the tests in the background had Ctrl-C ignored by everything in them.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    )
    run = in_a_process(code, "render diffuse -o s.exr --size 8x8 --spp 100000000 --sampler primal", cwd=tmp_path)
    assert run.returncode == 130, run.stderr
    assert "a second signal, discards it all" in run.stderr and "Traceback" not in run.stderr
    assert os.listdir(tmp_path) == [] and "error: interrupted" in run.stderr


def test_rendering_without_llvm_says_what_to_install(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    code = "import data_gen.llvm as l; l._PATTERNS = ()"
    run = in_a_process(code, "render diffuse -o s.exr", cwd=tmp_path, env=environment)
    assert run.returncode == 1 and os.listdir(tmp_path) == []
    assert "libllvm19" in run.stderr and run.stderr.count("\n") == 1


def test_demo(renderer, tmp_path, command):
    line = "demo -o demo --scene diffuse --spp 16 --reference-spp 256 --size 48x32"
    output, errors = command(line)
    assert "diffuse: stack: 0/16 spp" in errors and "report: demo/report.html" in errors
    written = set(os.listdir("demo"))
    assert {"report.html", "diffuse_stack.exr", "diffuse_ref.exr", "diffuse_l1.exr", "diffuse_l2.exr"} <= written
    assert "diffuse_nlm.exr" not in written  # a study
    assert "relMSE" in (tmp_path / "demo" / "report.html").read_text()
    rows = {words[1]: float(words[2]) for words in map(str.split, output.splitlines()[1:])}
    assert rows["l1"] < rows["primal"] / 3
    command(line, 1)  # the report is there already
