"""The examples of docs/use/farm: farms run what `ngpt` accepts, each frame once, each part with a seed of its own."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from verbs import parser_of

# It may be installed in an environment that is not in the path.
OPENJD = shutil.which("openjd") or shutil.which("openjd", path=Path(sys.executable).parent)
FARM = Path(__file__).parents[1] / "docs" / "use" / "farm"
FAKE = '#!/bin/sh\nfor word in "$@"; do printf \'%s\\t\' "$word"; done >> "$FARM_LOG"\necho >> "$FARM_LOG"\n'
# Runs what it is given at once: each number of an array, or the command of --wrap.
SBATCH = """#!/bin/bash
for word in "$@"; do
    case $word in
        --array=*) array=${word#--array=};;
        -*) ;;
        *) [ "$wrap" = 1 ] && command=$word || script=${script:-$word};;
    esac
    [ "$word" = --wrap ] && wrap=1
done
if [ -n "$command" ]; then bash -c "$command"; exit; fi
while [ "$1" != "$script" ]; do shift; done
for n in $(seq ${array%-*} ${array#*-}); do
    SLURM_ARRAY_TASK_ID=$n SLURM_ARRAY_TASK_COUNT=$((${array#*-} - ${array%-*} + 1)) "$@" || exit 1
done
echo 4711
"""
# Renders until it gets SIGTERM, and the second time to the end.
STOPPED = """#!/bin/bash
echo "$@" >> "$FARM_LOG"
[ -e "$FARM_LOG.stopped" ] && exit 0
trap 'touch "$FARM_LOG.stopped"; sleep 0.2; exit 143' TERM
kill -TERM $PPID
for n in $(seq 100); do sleep 0.1; done
"""
SCONTROL = '#!/bin/bash\necho scontrol "$@" >> "$FARM_LOG"\n'


def parsed(words):
    """What the verb makes of its words; leaves with status 2 where it does not accept them."""
    return SimpleNamespace(**{"verb": words[0]} | vars(parser_of(words[0]).parse_args(words[1:])))


class Farm:
    """A machine of a farm, whose `ngpt` writes down how it is called; parts that it merges are there."""

    def __init__(self, folder):
        self.out, self.scene, self.tools, self.log = (
            folder / "out",
            folder / "my scene.xml",
            folder / "bin",
            folder / "log",
        )
        self.scene.write_text("<scene/>")
        for place in (self.tools, self.out):
            place.mkdir()
        for seed in (1, 2, 3):
            (self.out / f"part.{seed}.exr").touch()
        self.tool(ngpt=FAKE, sbatch=SBATCH)

    def tool(self, **programs):
        for name, text in programs.items():
            (self.tools / name).write_text(text)
            (self.tools / name).chmod(0o755)

    def run(self, *command) -> list[SimpleNamespace]:
        """The calls of `ngpt`, parsed by the verb."""
        self.log.write_text("")
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return [parsed(line.rstrip("\t").split("\t")) for line in self.log.read_text().splitlines()]


@pytest.fixture
def farm(tmp_path, monkeypatch):
    made = Farm(tmp_path)
    monkeypatch.setenv("PATH", f"{made.tools}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FARM_LOG", str(made.log))
    return made


def shares(calls):
    """The renders, which may be started again."""
    renders = [call for call in calls if call.verb == "render"]
    # What is chosen in a pilot may differ from task to task.
    assert all(call.skip_existing and call.sampler != "auto" for call in renders)
    return renders


def check_still(farm, calls, spp):
    """Three parts of so many samples, one stack of them, one image."""
    *renders, merge, denoise = calls
    assert [call.seed for call in shares(renders)] == [1, 2, 3] and {call.spp for call in renders} == {spp}
    assert {call.scene for call in renders} == {str(farm.scene)}
    assert merge.verb == "merge" and sorted(merge.stacks) == sorted(call.output for call in renders)
    assert denoise.verb == "denoise" and [merge.output] == denoise.stacks


@pytest.mark.slow
@pytest.mark.skipif(OPENJD is None, reason="needs openjd-cli")
def test_open_job_description(farm):
    def run(name, step, *parameters):
        assert "passes validation checks" in subprocess.check_output([OPENJD, "check", FARM / name], text=True)
        given = [word for each in (f"Scene={farm.scene}", f"Out={farm.out}", *parameters) for word in ("-p", each)]
        return farm.run(OPENJD, "run", FARM / name, "--step", step, "--run-dependencies", *given)

    *renders, last = run("openjd-shot.yaml", "Denoise", "Frames=0-9,20")
    assert sorted(n for call in shares(renders) for n in call.frames) == [*range(10), 20] and len(renders) == 2
    assert last.verb == "denoise" and last.temporal and last.skip_existing
    check_still(farm, run("openjd-still.yaml", "Merge", "Parts=3"), 1000)


def test_slurm(farm):
    check_still(farm, farm.run(FARM / "slurm-still.sh", farm.scene, farm.out, 3, 500), 500)
    calls = farm.run("sbatch", "--array=0-2", FARM / "slurm-shot.sh", farm.scene, farm.out, "0:240")
    assert [call.shard for call in shares(calls)] == [(0, 3), (1, 3), (2, 3)]
    assert all(call.frames == list(range(240)) for call in calls)


def test_slurm_has_a_part_that_ran_out_of_time_run_again(farm, monkeypatch):
    """As Slurm does it: it signals the script, ends with its status, and runs it again once it is queued anew."""
    farm.tool(ngpt=STOPPED, scontrol=SCONTROL)
    for name, number in (("SLURM_ARRAY_JOB_ID", "4711"), ("SLURM_ARRAY_TASK_ID", "2")):
        monkeypatch.setenv(name, number)
    script = [str(FARM / "slurm-still.sh"), str(farm.scene), str(farm.out), "3", "500"]
    statuses = [subprocess.run(script, timeout=60, check=False).returncode for _ in range(2)]
    first, queued, again = farm.log.read_text().splitlines()
    assert statuses == [143, 0] and queued == "scontrol requeue 4711_2"
    assert first == again and "--skip-existing" in first
    # The signal goes to the script, which Slurm does not do by itself.
    assert "--signal=B:TERM@" in (FARM / "slurm-still.sh").read_text()
