"""Full disks, folders that cannot be written, several writers: one line says so, and nothing half-written is left."""

import os
import resource
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import pytest
from processes import COMMANDS, ROOT, complete, half_written, make_work, one_error, start, temporary_files
from reliability import record

import ngpt
from ngpt.errors import NgptError
from ngpt.system.files import atomic_output

FAST = ["denoise", "merge", "export", "eval"]

# In a mount namespace of its own, which ends with the process: no mount is ever seen by anyone else, or left.
MOUNTED = """
set -e
place=$1 options=$2 copy=$3
shift 3
mount -t tmpfs -o "$options" ngpt "$place"
case $copy in
read-only) mount -o remount,ro "$place"; exec "$@";;
*) set +e; "$@"; status=$?; cp -a "$place/." "$copy/"; exit $status;;
esac
"""


@cache
def unshare() -> tuple[str, ...]:
    """The command that starts another in such a namespace; skips the test where there is none."""
    for command in (("unshare", "--mount"), ("unshare", "--map-root-user", "--mount")):
        try:
            test = subprocess.run([*command, "mount", "-t", "tmpfs", "ngpt", "/mnt"], capture_output=True, timeout=30)
        except OSError:
            break
        if test.returncode == 0:
            return command
    pytest.skip("nothing can be mounted here: neither root nor user namespaces")


def on_small_disk(arguments, place: Path, kibibytes: int, copy: Path):
    """Runs a command with a disk of that size mounted on ``place``; what is there in the end is copied.

    A disk of 0 KiB has a page, since none has less, but no room for a name beside its own.
    """
    options = f"size={kibibytes}k" if kibibytes else "size=4k,nr_inodes=1"
    copy.mkdir()
    command = [*unshare(), "sh", "-c", MOUNTED, "sh", place, options, copy, *arguments]
    return complete(command)


def disk_campaign(kind, folder, disks):
    job, clock = make_work(kind, folder), time.monotonic()
    whole, place = folder / "whole", folder / "disk"
    place.mkdir()
    undisturbed = complete(job.arguments(whole))
    assert undisturbed.returncode == 0, undisturbed.stderr
    pages = sum(-(-path.stat().st_size // 4096) + 1 for path in whole.rglob("*") if path.is_file())
    job.arguments(place)  # makes its inputs, where it has any
    outcomes = {"one line, nothing half-written": 0, "it was enough": 0}
    for i in range(disks):
        copy = folder / f"left{i}"
        size = 4 * int(pages * (i + 0.5) / disks)
        run = on_small_disk(job.arguments(place), place, size, copy)
        assert half_written(copy) == [] and temporary_files(copy) == [], (size, run.stderr)
        for kept in ROOT.glob("*.kept*"):  # what took long to make goes to the working directory
            assert str(kept) in run.stderr
            kept.unlink()
        if run.returncode:
            assert run.returncode in (1, 2) and one_error(run.stderr), (size, run.stderr)
            assert "No space left" in run.stderr or "cannot be written" in run.stderr, run.stderr
        outcomes["one line, nothing half-written" if run.returncode else "it was enough"] += 1
        shutil.rmtree(copy)  # a copy: the disk itself is gone
    assert outcomes["one line, nothing half-written"]
    record(f"Full disk under {job.name}", disks, outcomes, seconds=round(time.monotonic() - clock))


@pytest.mark.parametrize("kind", ["denoise", "export"])
def test_a_full_disk(tmp_path, kind):
    disk_campaign(kind, tmp_path, 2)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", COMMANDS)
def test_full_disks(tmp_path, kind):
    disk_campaign(kind, tmp_path, 8)


def test_files_that_may_not_grow(tmp_path):
    """As where nothing can be mounted: a limit on the size of files is met by the same code."""
    job = make_work("denoise", tmp_path)

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))

    run = complete(job.arguments(tmp_path / "out"), preexec_fn=limit)
    assert run.returncode == 1 and one_error(run.stderr), run.stderr
    assert os.listdir(tmp_path / "out") == []


def read_only_campaign(kinds, folder):
    unshare()
    outcomes = {"one line": 0}
    for kind in kinds:
        (folder / kind).mkdir()
        job, place = make_work(kind, folder / kind), folder / kind / "place"
        place.mkdir()
        arguments = job.arguments(place)
        command = [*unshare(), "sh", "-c", MOUNTED, "sh", place, "size=64k", "read-only", *arguments]
        run = complete(command)
        assert run.returncode in (1, 2) and one_error(run.stderr), (kind, run.stderr)
        assert len(run.stderr.splitlines()) == 1, run.stderr
        outcomes["one line"] += 1
    record("Read-only folders, one for each command", len(kinds), outcomes)


def test_read_only_folders(tmp_path):
    read_only_campaign(["denoise", "merge", "export"], tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_read_only_folders_of_all_commands(tmp_path):
    read_only_campaign(COMMANDS, tmp_path)


@pytest.mark.parametrize("writers", [8, pytest.param(64, marks=pytest.mark.slow)])
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


def test_two_commands_with_one_output(tmp_path):
    job = make_work("merge", tmp_path)
    arguments = job.arguments(tmp_path / "out")[:-1]
    statuses = []
    processes = [start(arguments) for _ in range(3)]
    for process in processes:
        _, errors = process.communicate(timeout=120)
        statuses.append(process.returncode)
        assert process.returncode == 0 or ("exists already" in errors and one_error(errors)), errors
    assert statuses.count(0) == 1
    ngpt.read(tmp_path / "out" / "merged.exr")
    assert temporary_files(tmp_path) == []


@pytest.mark.parametrize("kind", ["eval", pytest.param("train", marks=pytest.mark.slow)])
def test_a_folder_that_another_run_writes_to_is_refused(tmp_path, kind):
    job, out = make_work(kind, tmp_path), tmp_path / "out"
    out.mkdir()
    code = "import sys; from ngpt.system.files import exclusive\n"
    code += "with exclusive(sys.argv[1]): print('x', flush=True); input()"
    with start([sys.executable, "-c", code, out], stdin=-1, stdout=-1) as other:
        other.stdout.readline()
        run = complete(job.arguments(out))
        assert run.returncode == 1 and "another process is writing there" in run.stderr and one_error(run.stderr)
        other.stdin.write("\n")
        other.stdin.close()
    assert complete(job.arguments(out)).returncode == 0


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
