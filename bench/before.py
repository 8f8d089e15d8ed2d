"""What a change costs where it should cost nothing: a sampler of this checkout against that of an earlier commit.

    python -m bench.before c8ac1af --scenes cornell-box/scene.xml glossy

The commit is checked out into a temporary folder, and each of the two renders in a process of its own. They take turns,
kernels compiled before, so that a busy moment hits both alike. Times are CPU seconds, on one thread.

    ratio       CPU time of a stack here over that of the same seed there: median and quartiles over --repeats seeds
    operations  of the largest kernel, in which paths are traced
    same bits   whether both have rendered the same stack

A table is printed; all numbers are written as JSON.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.common import metadata, save, summary
from ngpt.evaluation.config import scene_name

ROOT = Path(__file__).parents[1]
# The first argument of the processes that render.
WORKER = "--worker"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit")
    parser.add_argument("--scenes", nargs="*", default=["diffuse", "glossy"], help="scene files and built-in scenes")
    parser.add_argument("--sampler", default="gpt")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("-o", "--output", type=Path, default=Path("bench/results/before.json"))
    args = parser.parse_args()
    samples = args.size[0] * args.size[1] * args.spp
    result = {"benchmark": "before", **vars(args), "metadata": metadata("mitsuba", "drjit"), "scenes": {}}
    del result["output"]
    with tempfile.TemporaryDirectory() as folder:
        git("worktree", "add", "--detach", folder, args.commit)
        try:
            for scene in args.scenes:
                scene = str(Path(scene).resolve()) if scene.endswith(".xml") else scene
                row = bench_scene(scene, {"here": ROOT, "there": Path(folder)}, args)
                result["scenes"][scene_name(scene)] = row
                save(args.output, result)
                ns = {name: row[name]["CPU seconds"]["median"] / samples * 1e9 for name in ("here", "there")}
                print(
                    f"{scene_name(scene):16} {ns['here']:.0f} and {ns['there']:.0f} ns a sample, "
                    f"ratio {row['ratio']['median']:.3f} ({row['ratio']['low']:.3f} .. {row['ratio']['high']:.3f}), "
                    f"{row['here']['operations']} and {row['there']['operations']} operations, "
                    f"{'the same' if row['same bits'] else 'other'} bits",
                    flush=True,
                )
        finally:
            git("worktree", "remove", "--force", folder)


def git(*arguments: str) -> None:
    subprocess.run(["git", *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def bench_scene(scene: str, checkouts: dict[str, Path], args: argparse.Namespace) -> dict:
    runs: dict[str, list[dict]] = {name: [] for name in checkouts}
    workers = {name: start(folder, scene, args) for name, folder in checkouts.items()}
    try:
        for seed in range(args.repeats + 1):
            # Who is first changes, and the first run compiles.
            for name in sorted(workers, reverse=bool(seed % 2)):
                told = ask(workers[name], seed)
                if seed:
                    runs[name].append(told)
    finally:
        for worker in workers.values():
            worker.kill()
            worker.wait()
    ratios = [a["seconds"] / b["seconds"] for a, b in zip(runs["here"], runs["there"], strict=True)]
    times = {name: summary([told["seconds"] for told in row]) for name, row in runs.items()}
    return {
        "ratio": summary(ratios),
        "same bits": all(a["digest"] == b["digest"] for a, b in zip(runs["here"], runs["there"], strict=True)),
        **{name: {"CPU seconds": times[name], "operations": row[-1]["operations"]} for name, row in runs.items()},
    }


def start(folder: Path, scene: str, args: argparse.Namespace) -> subprocess.Popen:
    """This file again, which imports the samplers of ``folder``."""
    numbers = [str(number) for number in (*args.size, args.spp)]
    return subprocess.Popen(
        # Without -P the folder of this file would hide modules of the same names.
        [sys.executable, "-P", __file__, WORKER, scene, args.sampler, *numbers],
        env=os.environ | {"PYTHONPATH": str(folder)},
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(worker: subprocess.Popen, seed: int) -> dict:
    assert worker.stdin and worker.stdout
    worker.stdin.write(f"{seed}\n")
    worker.stdin.flush()
    return json.loads(worker.stdout.readline())


def work(path: str, sampler: str, width: str, height: str, spp: str) -> None:
    """Renders a stack for each seed that comes in, and tells what it took."""
    from data_gen.backend import use_variant

    use_variant()
    import drjit as dr

    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    dr.set_thread_count(1)
    scene = load_scene(path, (int(width), int(height)))
    for seed in sys.stdin:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            begin = time.process_time()
            stack = render_stack(scene, int(spp), int(seed), sampler)
            seconds = time.process_time() - begin
            operations = max(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
        digest = hashlib.sha256(b"".join(stack[name].tobytes() for name in sorted(stack.names))).hexdigest()
        print(json.dumps({"seconds": seconds, "operations": operations, "digest": digest}), flush=True)


if __name__ == "__main__":
    work(*sys.argv[2:]) if sys.argv[1:2] == [WORKER] else main()
