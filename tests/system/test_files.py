"""Files appear complete or not at all, and nothing is overwritten by accident."""

import os
import subprocess
import sys

import pytest

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output, exclusive


def test_appears_only_when_the_block_succeeds(tmp_path):
    path = tmp_path / "a.txt"
    with atomic_output(path) as temporary:
        temporary.write_text("done")
        assert not path.exists() and temporary.suffix == ".txt"
    assert path.read_text() == "done"
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()
    assert os.listdir(tmp_path) == ["a.txt"]


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_failure_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_output(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == []


def test_overwrites_only_when_told(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(NgptError, match="--force"), atomic_output(path):
        pass
    assert path.read_text() == "old"
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_a_file_that_another_writer_finished_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(NgptError, match="exists already"), atomic_output(path) as temporary:
        temporary.write_text("mine")
        path.write_text("theirs")
    assert path.read_text() == "theirs" and os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("name", ["missing/a.txt", "."])
def test_places_that_cannot_be_written(tmp_path, name):
    with pytest.raises(NgptError, match=r"does not exist|is a directory"), atomic_output(tmp_path / name):
        pass


def test_a_folder_belongs_to_one_writer_at_a_time(tmp_path):
    with exclusive(tmp_path), pytest.raises(NgptError, match="another process is writing there"), exclusive(tmp_path):
        pass
    with exclusive(tmp_path):
        pass


def test_what_killed_writers_left_is_swept_away_and_nothing_else(tmp_path):
    (tmp_path / ".ngpt-abcd0123.exr").write_text("half")
    (tmp_path / ".ngpt-mine.exr").write_text("a user's own")
    (tmp_path / ".hidden").write_text("too")
    code = (
        "import sys; from ngpt.system.files import atomic_output\n"
        "with atomic_output(sys.argv[1]) as temporary: print(temporary.name, flush=True); input()"
    )
    command = [sys.executable, "-c", code, tmp_path / "theirs.txt"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as living:
        name = living.stdout.readline().strip()
        with atomic_output(tmp_path / "ours.txt") as temporary:
            temporary.write_text("done")
        assert sorted(os.listdir(tmp_path)) == sorted([".hidden", ".ngpt-mine.exr", name, "ours.txt"])
        living.communicate("\n")
    assert sorted(os.listdir(tmp_path)) == [".hidden", ".ngpt-mine.exr", "ours.txt", "theirs.txt"]


def test_a_folder_that_cannot_be_locked_is_named(tmp_path):
    with pytest.raises(NgptError, match="nowhere: cannot be written: No such file"), exclusive(tmp_path / "nowhere"):
        pass
