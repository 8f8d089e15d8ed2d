"""``ngpt denoise - -o -``: an image goes through, and nothing else does."""

import io
import subprocess
import sys
import tempfile

import numpy as np
import pytest

import ngpt


@pytest.fixture
def data(noisy_stack, tmp_path):
    """The bytes of a file, noisy.exr."""
    return ngpt.write(tmp_path / "noisy.exr", noisy_stack[0]).read_bytes()


def put_in(monkeypatch, data):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


def test_an_image_goes_through(data, tmp_path, noisy_stack):
    command = [sys.executable, "-m", "ngpt", "denoise", "-", "-o", "-", "-m", "l1"]
    done = subprocess.run(command, input=data, capture_output=True, check=True)
    (tmp_path / "through.exr").write_bytes(done.stdout)
    assert np.array_equal(ngpt.read_image(tmp_path / "through.exr"), ngpt.denoise(noisy_stack[0], "l1"))
    assert done.stderr.count(b"\n") == 1 and b"l1" in done.stderr


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("info - --json", '"file": "standard input"'),
        ("diff - noisy.exr", "agree"),
        ("picture - -o made/a.png --force", "standard input -> made/a.png: "),
        ("report noisy.exr --ref - -o made/a.html --force", "made/a.html: open it"),
        ("unpack - made --force", "standard input -> made: "),
        ("denoise - -o made/a.exr -m primal --untrusted --force", "standard input -> made/a.exr: primal"),
    ],
)
def test_every_verb_that_reads_one_file_takes_it_by_standard_input(data, tmp_path, monkeypatch, command, line, said):
    for content, status, message in (
        (data, 0, said),
        (b"", 1, "ngpt: error: standard input: is empty"),
        (data[:-9], 1, "ngpt: error: standard input: damaged"),
    ):
        put_in(monkeypatch, content)
        told = "".join(command(line, status))
        assert message in told and tempfile.gettempdir() + "/ngpt-" not in told
    for page in tmp_path.glob("made/*.html"):
        assert tempfile.gettempdir() + "/ngpt-" not in page.read_text()
