"""Folders and disks that others use too: one line says so, and nothing half-written is left."""

import os
from concurrent.futures import ThreadPoolExecutor

import pytest
from processes import complete, make_work, start
from reliability import at_length, record

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output


@pytest.mark.parametrize("writers", [8, at_length(64)])
def test_of_many_writers_of_one_file_one_wins(tmp_path, writers):
    path, rounds = tmp_path / "a.txt", 5 * writers

    def write(number):
        try:
            with atomic_output(path) as temporary:
                temporary.write_text(str(number) * 1000)
        except NgptError as error:
            assert "exists already" in str(error)
            return None
        return str(number) * 1000

    with ThreadPoolExecutor(writers) as pool:
        for _ in range(rounds):
            written = [text for text in pool.map(write, range(writers)) if text is not None]
            assert written == [path.read_text()] and os.listdir(tmp_path) == ["a.txt"]
            path.unlink()
    tried = rounds * writers
    outcomes = {"written": rounds, "one line: exists already": tried - rounds}
    record("Writers of one file at the same time", tried, outcomes)


@pytest.mark.slow
def test_two_generations_into_one_folder(tmp_path):
    """Both work on all of it, as jobs whose parts overlap by mistake; the set is the same."""
    job = make_work("data_gen", tmp_path)
    processes = [start(job.arguments(tmp_path / "out")) for _ in range(2)]
    for process in processes:
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    assert complete(job.arguments(tmp_path / "alone")).returncode == 0
    assert job.results(tmp_path / "out") == job.results(tmp_path / "alone")
