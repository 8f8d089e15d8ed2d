"""``ngpt denoise - -o -``: an image goes through, and nothing else does."""

import io
import subprocess
import sys
import tempfile

import numpy as np
import pytest

import ngpt
from ngpt.cli import main


@pytest.fixture
def noisy(noisy_stack, tmp_path, monkeypatch):
    """The name of a file, in the current folder."""
    monkeypatch.chdir(tmp_path)
    ngpt.write("noisy.exr", noisy_stack[0])
    return "noisy.exr"


def test_an_image_goes_through(noisy, tmp_path):
    command = [sys.executable, "-m", "ngpt", "denoise", "-", "-o", "-", "-m", "l1"]
    done = subprocess.run(command, input=(tmp_path / noisy).read_bytes(), capture_output=True, check=True)
    (tmp_path / "through.exr").write_bytes(done.stdout)
    assert main(["denoise", noisy, "-o", "file.exr", "-m", "l1"]) == 0
    assert np.array_equal(ngpt.read_image("through.exr"), ngpt.read_image("file.exr"))
    assert done.stderr.count(b"\n") == 1 and b"l1" in done.stderr


def test_one_end_may_be_a_file(noisy, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO((tmp_path / noisy).read_bytes())))
    assert main(["denoise", "-", "-o", "from/here/", "-m", "l1"]) == 0
    assert (tmp_path / "from" / "here" / "standard-input.exr").is_file()
    assert main(["denoise", noisy, "-o", "new/folder", "-m", "l1"]) == 0
    assert (tmp_path / "new" / "folder" / noisy).is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["info", "-"], "file: standard input"),
        (["info", "-", "--json"], '"file": "standard input"'),
        (["diff", "-", "noisy.exr"], "agree"),
        (["diff", "noisy.exr", "-"], "agree"),
        (["picture", "-", "-o", "made/a.png"], "standard input -> made/a.png: "),
        (["report", "-", "-o", "made/a.html"], "made/a.html: open it"),
        (["report", "noisy.exr", "--ref", "-", "-o", "made/a.html"], "made/a.html: open it"),
        (["unpack", "-", "made"], "standard input -> made: "),
        (["denoise", "-", "-o", "made/a.exr", "-m", "primal", "--untrusted"], "standard input -> made/a.exr: primal"),
    ],
)
def test_every_verb_that_reads_one_file_takes_it_by_standard_input(
    noisy, tmp_path, monkeypatch, capfd, arguments, said
):
    data = (tmp_path / noisy).read_bytes()
    for content, status, message in (
        (data, 0, said),
        (b"", 1, "ngpt: error: standard input: is empty"),
        (data[:-9], 1, "ngpt: error: standard input: damaged"),
    ):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
        assert main([*arguments, *(["--force"] if arguments[0] not in ("info", "diff") else [])]) == status
        output, errors = capfd.readouterr()
        assert message in output + errors and tempfile.gettempdir() + "/ngpt-" not in output + errors
    for page in tmp_path.glob("made/*.html"):
        assert tempfile.gettempdir() + "/ngpt-" not in page.read_text()
