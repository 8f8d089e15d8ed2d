"""Configurations by name or path."""

import pytest

from ngpt.errors import NgptError
from ngpt.system.configs import DATASET, FOLDER, TRAINING, find_config


def test_a_name_is_found_from_anywhere_and_a_file_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("data-tiny", "data-tiny.toml"):
        assert find_config(name, DATASET) == FOLDER / "data-tiny.toml"
    (tmp_path / "data-tiny").mkdir()
    assert find_config("data-tiny", DATASET) == FOLDER / "data-tiny.toml"
    (tmp_path / "tiny").write_text("")
    assert find_config("tiny", TRAINING).samefile(tmp_path / "tiny")


@pytest.mark.parametrize("name", ["nope", "", "data-tiny", "configs/nope.toml", "a\0b", "x" * 5000])
def test_what_is_neither_is_told_what_there_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        NgptError,
        match=r"no such file; (did you mean .*\? )?ngpt has the configurations: .*combine, .*fast, .*tiny",
    ):
        find_config(name, TRAINING)
