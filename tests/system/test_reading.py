"""Input files are regular ones, and not larger than makes sense: nothing waits, and nothing fills the memory."""

import os

import pytest

from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.system import reading
from ngpt.system.reading import read_bytes, read_text


def test_a_file_is_read_up_to_its_bound(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345" and read_text(path) == "12345"
    with pytest.raises(NgptError, match="a: is larger than 0 MiB"):
        read_bytes(path, 4)
    monkeypatch.setattr(reading, "MOST_TEXT", 4)
    with pytest.raises(NgptError, match="larger than"):
        read_text(path)
    path.write_bytes(b"\xff")
    with pytest.raises(NgptError, match="a: cannot be read: 'utf-8'"):
        read_text(path)


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "line",
    [
        ["dataset", "--config", "{odd}", "--out", "out"],
        ["train", "--config", "{odd}", "--dry-run"],
        ["evaluate", "--config", "{odd}", "--out", "out"],
        ["render", "{odd}", "-o", "a.exr"],
        ["render", "diffuse", "--frames", "0:1", "--camera", "{odd}.json", "-o", "shot"],
        ["render", "diffuse", "--frames", "0:1", "--camera", "{odd}.gltf", "-o", "shot"],
        ["denoise", "{odd}", "-o", "a.exr"],
        ["denoise", "{odd}", "-m", "ngpt", "--weights", "{odd}.onnx", "-o", "a.exr"],
        ["info", "{odd}.onnx"],
        ["info", "{odd}.safetensors"],
        ["export", "--weights", "{odd}.safetensors", "-o", "a.onnx"],
        ["report", "{odd}"],
        ["merge", "{odd}", "{odd}", "-o", "a.exr"],
    ],
)
def test_no_verb_waits_for_a_pipe_or_reads_a_device(line, kind, tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba")
    monkeypatch.chdir(tmp_path)
    for name in ("odd", "odd.json", "odd.gltf", "odd.onnx", "odd.safetensors"):
        os.mkfifo(name) if kind == "pipe" else os.symlink("/dev/zero", name)
    assert main([word.format(odd="odd") for word in line]) == 1
    errors = capsys.readouterr().err
    assert errors.count("error:") == 1 and "odd" in errors
