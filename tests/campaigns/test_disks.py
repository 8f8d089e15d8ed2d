"""Full disks and folders that cannot be written: one line says so, and nothing half-written is left."""

import subprocess
import time
from functools import cache

import pytest
from processes import COMMANDS, ROOT, complete, half_written, make_work, one_error, temporary_files
from reliability import at_length, record

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


def on_a_disk(job, place, options: str, copy):
    """Runs a command with a disk mounted on ``place``; what is there in the end is copied, unless it is read-only."""
    arguments = job.arguments(place)
    return complete([*unshare(), "sh", "-c", MOUNTED, "sh", place, options, copy, *arguments])


@pytest.mark.parametrize(("kind", "disks"), [("denoise", 2), ("export", 2), *(at_length(kind, 8) for kind in COMMANDS)])
def test_full_disks(tmp_path, kind, disks):
    job, clock = make_work(kind, tmp_path), time.monotonic()
    whole, place = tmp_path / "whole", tmp_path / "disk"
    place.mkdir()
    undisturbed = complete(job.arguments(whole))
    assert undisturbed.returncode == 0, undisturbed.stderr
    pages = sum(-(-path.stat().st_size // 4096) + 1 for path in whole.rglob("*") if path.is_file())
    outcomes = {"one line, nothing half-written": 0, "it was enough": 0}
    for i in range(disks):
        copy, kibibytes = tmp_path / f"left{i}", 4 * int(pages * (i + 0.5) / disks)
        copy.mkdir()
        # A disk of 0 KiB has a page, since none has less, but no room for a name beside its own.
        run = on_a_disk(job, place, f"size={kibibytes}k" if kibibytes else "size=4k,nr_inodes=1", copy)
        assert half_written(copy) == [] and temporary_files(copy) == [], (kibibytes, run.stderr)
        for kept in ROOT.glob("*.kept*"):  # what took long to make goes to the working directory
            assert str(kept) in run.stderr
            kept.unlink()
        if run.returncode:
            assert run.returncode in (1, 2) and one_error(run.stderr), (kibibytes, run.stderr)
            assert "No space left" in run.stderr or "cannot be written" in run.stderr, run.stderr
        outcomes["one line, nothing half-written" if run.returncode else "it was enough"] += 1
    assert outcomes["one line, nothing half-written"]
    record(f"Full disk under {job.name}", disks, outcomes, seconds=round(time.monotonic() - clock))


@pytest.mark.parametrize("kinds", [["denoise", "merge", "export"], at_length(list(COMMANDS))])
def test_read_only_folders(tmp_path, kinds):
    for kind in kinds:
        place = tmp_path / kind / "place"
        place.mkdir(parents=True)
        run = on_a_disk(make_work(kind, tmp_path / kind), place, "size=64k", "read-only")
        assert run.returncode in (1, 2) and one_error(run.stderr), (kind, run.stderr)
        assert len(run.stderr.splitlines()) == 1, run.stderr
    record("Read-only folders, one for each command", len(kinds), {"one line": len(kinds)})
