"""Faults put into the product one by one, each in a copy of the tree: the tests named beside it must fail.

python -m tests.mutants [NAME ...]        those of tests/mutants.toml, all or by name; status 1 where one survives
"""

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

TREE = Path(__file__).parents[1]
COPIED = ("ngpt", "data_gen", "studies", "tests", "configs", "export")
COPIED += ("conftest.py", "train.py", "eval.py", "pyproject.toml")


def killed(mutant: dict, copy: Path) -> bool:
    """Whether the tests fail with the fault. Raises SystemExit where it no longer fits, or where no test runs."""
    file, clean = copy / mutant["file"], (TREE / mutant["file"]).read_text("utf-8")
    if clean.count(mutant["old"]) != 1:
        raise SystemExit(f"{mutant['file']}: has '{mutant['old']}' {clean.count(mutant['old'])} times, not once")
    file.write_text(clean.replace(mutant["old"], mutant["new"]), "utf-8")
    call = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *mutant["tests"]]
    done = subprocess.run(
        call, cwd=copy, env=os.environ | {"PYTHONPATH": f"{copy}:{copy / 'studies'}"}, stdout=subprocess.PIPE, text=True
    )
    file.write_text(clean, "utf-8")
    # 1: tests failed; 0: none did
    if done.returncode not in (0, 1):
        raise SystemExit(done.stdout)
    return done.returncode == 1


def main() -> None:
    mutants = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        for name in COPIED:
            source, copy = TREE / name, Path(folder) / name
            (shutil.copytree if source.is_dir() else shutil.copy)(source, copy)
        for name in sys.argv[1:] or mutants:
            dead = killed(mutants[name], Path(folder))
            survivors += [] if dead else [name]
            print(f"{'killed' if dead else 'SURVIVES':9} {name:35} {mutants[name]['file']}", flush=True)
    sys.exit(f"{len(survivors)} survive: {', '.join(survivors)}" if survivors else 0)


if __name__ == "__main__":
    main()
