"""The examples of docs/use/farm: farms run what `ngpt` accepts, each frame once, each part with a seed of its own."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

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


@pytest.fixture
def farm(tmp_path, monkeypatch):
    """A folder whose `ngpt` writes down how it is called, and a function that gives these calls, parsed by the verb."""
    tools = tmp_path / "bin"
    tools.mkdir()
    for name, text in (("ngpt", FAKE), ("sbatch", SBATCH)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FARM_LOG", str(tmp_path / "log"))
    for folder in ("out", "my scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "my scene" / "scene.xml").write_text("<scene/>")

    def calls():
        lines = (tmp_path / "log").read_text().splitlines()
        return [parsed(line.rstrip("\t").split("\t")) for line in lines]

    return SimpleNamespace(folder=tmp_path, scene=str(tmp_path / "my scene" / "scene.xml"), calls=calls)


def parsed(words):
    """What the verb makes of its words; leaves with status 2 where it does not accept them."""
    return SimpleNamespace(**{"verb": words[0]} | vars(parser_of(words[0]).parse_args(words[1:])))


def run(*command, **more):
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def shares(calls):
    """All frames of the renders, and that they may be started again."""
    renders = [call for call in calls if call.verb == "render"]
    # What is chosen in a pilot may differ from task to task.
    assert all(call.skip_existing and call.sampler != "auto" for call in renders)
    return renders


@pytest.mark.skipif(OPENJD is None, reason="needs openjd-cli")
def test_open_job_description(farm):
    given = ["-p", f"Scene={farm.scene}", "-p", f"Out={farm.folder / 'out'}"]
    for name in ("openjd-shot.yaml", "openjd-still.yaml"):
        assert "passes validation checks" in run(OPENJD, "check", str(FARM / name))
    frames = ["-p", "Frames=0-9,20"]
    run(OPENJD, "run", str(FARM / "openjd-shot.yaml"), "--step", "Denoise", "--run-dependencies", *given, *frames)
    *renders, last = farm.calls()
    assert sorted(n for call in shares(renders) for n in call.frames) == [*range(10), 20] and len(renders) == 2
    assert last.verb == "denoise" and last.temporal and last.skip_existing
    (farm.folder / "log").unlink()
    for seed in (1, 2, 3):
        (farm.folder / "out" / f"part.{seed}.exr").touch()
    run(
        OPENJD,
        "run",
        str(FARM / "openjd-still.yaml"),
        "--step",
        "Merge",
        "--run-dependencies",
        *given,
        "-p",
        "Parts=3",
    )
    check_still(farm, 1000)


def test_slurm(farm):
    for seed in (1, 2, 3):
        (farm.folder / "out" / f"part.{seed}.exr").touch()
    run(str(FARM / "slurm-still.sh"), farm.scene, str(farm.folder / "out"), "3", "500")
    check_still(farm, 500)
    (farm.folder / "log").unlink()
    run("sbatch", "--array=0-2", str(FARM / "slurm-shot.sh"), farm.scene, str(farm.folder / "out"), "0:240")
    assert [call.shard for call in shares(farm.calls())] == [(0, 3), (1, 3), (2, 3)]
    assert all(call.frames == list(range(240)) for call in farm.calls())


# Renders until it gets SIGTERM, and the second time to the end.
STOPPED = """#!/bin/bash
echo "$@" >> "$FARM_LOG"
[ -e "$FARM_LOG.stopped" ] && exit 0
trap 'touch "$FARM_LOG.stopped"; sleep 0.2; exit 143' TERM
kill -TERM $PPID
for n in $(seq 100); do sleep 0.1; done
"""
SCONTROL = """#!/bin/bash
echo scontrol "$@" >> "$FARM_LOG"
"""


def test_slurm_has_a_part_that_ran_out_of_time_run_again(farm, monkeypatch):
    """As Slurm does it: it signals the script, ends with its status, and runs it again once it is queued anew."""
    for name, text in (("ngpt", STOPPED), ("scontrol", SCONTROL)):
        (farm.folder / "bin" / name).write_text(text)
        (farm.folder / "bin" / name).chmod(0o755)
    for name, number in (("SLURM_ARRAY_JOB_ID", "4711"), ("SLURM_ARRAY_TASK_ID", "2")):
        monkeypatch.setenv(name, number)
    script = [str(FARM / "slurm-still.sh"), farm.scene, str(farm.folder / "out"), "3", "500"]
    statuses = [subprocess.run(script, timeout=60, check=False).returncode for _ in range(2)]
    first, queued, again = (farm.folder / "log").read_text().splitlines()
    assert statuses == [143, 0] and queued == "scontrol requeue 4711_2"
    assert first == again and "--skip-existing" in first
    # The signal goes to the script, which Slurm does not do by itself.
    assert "--signal=B:TERM@" in (FARM / "slurm-still.sh").read_text()


def check_still(farm, spp):
    """Three parts of so many samples, one stack of them, one image."""
    *renders, merge, denoise = farm.calls()
    assert [call.seed for call in shares(renders)] == [1, 2, 3] and {call.spp for call in renders} == {spp}
    assert {call.scene for call in renders} == {farm.scene}
    assert merge.verb == "merge" and sorted(merge.stacks) == sorted(call.output for call in renders)
    assert denoise.verb == "denoise" and [merge.output] == denoise.stacks


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
def test_flamenco(farm):
    """Its manager gives a script these three: frameChunker, author, and the job."""
    stand_in = """
    const frameChunker = (frames, size) => ["0-7", "8,9"];
    const author = {
        Task: (name, type) => ({ name, type, commands: [], after: [], addCommand(c) { this.commands.push(c); },
                                 addDependency(t) { this.after.push(t.name); } }),
        Command: (name, parameters) => ({ name, parameters }),
    };
    const tasks = [];
    """
    settings = {"frames": "0-9", "scene": farm.scene, "out": "/out", "chunk_size": 8, "spp": 4}
    call = f"compileJob({{ settings: {json.dumps(settings)}, addTask: task => tasks.push(task) }});"
    ask = "console.log(JSON.stringify([JOB_TYPE, tasks]));"
    program = f"{stand_in}{(FARM / 'ngpt-shot.js').read_text()}{call}{ask}"
    kind, tasks = json.loads(run("node", "-e", program))
    assert {setting["key"] for setting in kind["settings"]} == set(settings)
    commands = [task["commands"][0]["parameters"] for task in tasks]
    assert all(command["exe"] == "ngpt" for command in commands)
    *renders, denoise = [parsed(command["args"]) for command in commands]
    assert [n for call in shares(renders) for n in call.frames] == list(range(10))
    assert denoise.temporal and tasks[-1]["after"] == ["render-0-7", "render-8,9"]


def test_opencue(farm, monkeypatch):
    """What an outline sends is the command of each layer, its words with spaces between."""
    layers, launched = [], []

    class Layer:
        def __init__(self, name, **arguments):
            self.name, self.arguments, self.after = name, arguments, []

        def depend_all(self, other):
            self.after.append(other.name)

    class Outline:
        def __init__(self, name, **_):
            self.add_layer = layers.append

    names = ("outline", "outline.modules", "outline.modules.shell")
    outline, _, shell = modules = [ModuleType(name) for name in names]
    outline.Outline = Outline
    outline.cuerun = SimpleNamespace(launch=lambda job, **options: launched.append(options))
    shell.Shell = shell.ShellCommand = Layer
    for name, module in zip(names, modules, strict=True):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "argv", ["opencue-shot.py", farm.scene, "/my out", "0-119"])
    exec(compile((FARM / "opencue-shot.py").read_text(), "opencue-shot.py", "exec"), {})
    render, denoise = layers
    assert launched == [{"use_pycuerun": False}] and denoise.after == ["render"]
    assert render.arguments["range"] == "0-119" and render.arguments["chunk"] == 8
    lines = [" ".join(layer.arguments["command"]).replace("#FRAMESPEC#", "1-9x2") for layer in layers]
    first, last = (parsed(shlex.split(line)[1:]) for line in lines)
    assert shares([first])[0].frames == [1, 3, 5, 7, 9] and first.scene == farm.scene
    assert first.output == "/my out/stacks" and last.stacks == ["/my out/stacks"]
