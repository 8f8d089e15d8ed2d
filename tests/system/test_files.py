"""Files appear complete or not at all, and nothing is overwritten by accident."""

import os
import subprocess
import sys

import pytest

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output, exclusive, save


def hours_of_work(path, overwrite=False):
    with atomic_output(path, overwrite) as temporary:
        temporary.write_text("hours")


def test_appears_only_when_the_block_succeeds(tmp_path):
    path, before = tmp_path / "a.txt", os.umask(0o027)
    try:
        with atomic_output(path) as temporary:
            temporary.write_text("done")
            assert not path.exists() and temporary.suffix == ".txt"
    finally:
        os.umask(before)
    assert path.read_text() == "done" and path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(ZeroDivisionError), atomic_output(tmp_path / "b.txt") as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == ["a.txt"]


def test_overwrites_only_when_told(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(NgptError, match="--force"):
        hours_of_work(path)
    assert path.read_text() == "old"
    hours_of_work(path, overwrite=True)
    assert path.read_text() == "hours"


def test_links_stay_links(tmp_path):
    (tmp_path / "real").mkdir()
    file, link, dangling = tmp_path / "real" / "a.txt", tmp_path / "link.txt", tmp_path / "new.txt"
    file.write_text("old")
    link.symlink_to(file)
    dangling.symlink_to(tmp_path / "real" / "b.txt")
    with pytest.raises(NgptError, match="--force"):
        hours_of_work(link)
    hours_of_work(link, overwrite=True)
    hours_of_work(dangling)
    assert link.is_symlink() and file.read_text() == "hours"
    assert dangling.is_symlink() and (tmp_path / "real" / "b.txt").read_text() == "hours"


def test_a_file_that_another_writer_finished_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(NgptError, match="exists already"), atomic_output(path) as temporary:
        temporary.write_text("mine")
        path.write_text("theirs")
    assert path.read_text() == "theirs" and os.listdir(tmp_path) == ["a.txt"]


def test_a_folder_belongs_to_one_writer_at_a_time(tmp_path):
    with exclusive(tmp_path), pytest.raises(NgptError, match="another process is writing there"), exclusive(tmp_path):
        pass
    with exclusive(tmp_path):
        pass
    with pytest.raises(NgptError, match="nowhere: cannot be written: No such file"), exclusive(tmp_path / "nowhere"):
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
        hours_of_work(tmp_path / "ours.txt")
        assert sorted(os.listdir(tmp_path)) == sorted([".hidden", ".ngpt-mine.exr", name, "ours.txt"])
        living.communicate("\n")
    assert sorted(os.listdir(tmp_path)) == [".hidden", ".ngpt-mine.exr", "ours.txt", "theirs.txt"]


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A folder to write to, the working directory and the folder for temporary files."""
    found = [tmp_path / name for name in ("asked", "working", "temporary")]
    for folder in found:
        folder.mkdir()
    monkeypatch.chdir(found[1])
    monkeypatch.setattr("tempfile.tempdir", str(found[2]))
    return found


def test_what_cannot_be_written_is_kept_elsewhere_and_the_message_says_where(places):
    asked, working, _ = places
    save(asked / "a.txt", hours_of_work)
    for name in ("a.kept.txt", "a.kept-2.txt"):  # the name is taken, and nothing is overwritten
        with pytest.raises(NgptError, match=rf"exists already.*; what was made is kept in {asked / name}$"):
            save(asked / "a.txt", hours_of_work)
        assert (asked / name).read_text() == "hours"
    save(asked / "a.txt", hours_of_work, True)
    with pytest.raises(NgptError, match=rf"gone does not exist.* kept in {working / 'a.kept.txt'}$"):
        save(asked / "gone" / "a.txt", hours_of_work, True)
    # One that others make too, in a folder all of whose files count.
    save(asked / "a.txt", hours_of_work, alike=True)
    (asked / "b.txt").mkdir()
    with pytest.raises(NgptError, match=rf"kept in {working / 'b.kept.txt'}$"):
        save(asked / "b.txt", hours_of_work, alike=True)
    assert sorted(os.listdir(asked)) == ["a.kept-2.txt", "a.kept.txt", "a.txt", "b.txt"]


def test_a_working_directory_that_is_full_or_gone_leaves_the_folder_for_temporary_files(places):
    asked, working, temporary = places
    free = [temporary]

    def on_full_disks(path, overwrite):
        with atomic_output(path, overwrite) as unfinished:
            unfinished.write_text("hours")
            if path.parent not in free:
                raise OSError(28, "No space left on device")

    with pytest.raises(NgptError, match=rf"a.txt: .*No space left.*; what was made is kept in {temporary / 'a.kept'}"):
        save(asked / "a.txt", on_full_disks)
    assert [os.listdir(folder) for folder in places] == [[], [], ["a.kept.txt"]]
    free.clear()
    with pytest.raises(NgptError, match=r"a.txt: .*No space left.*; nor can it be written elsewhere, so it is lost$"):
        save(asked / "a.txt", on_full_disks)
    working.rmdir()
    with pytest.raises(NgptError, match=rf"kept in {temporary / 'b.kept.txt'}$"):
        save(asked / "gone" / "b.txt", hours_of_work)
