"""Every method on the same scenes with the same clock: python eval.py --config configs/eval-NAME.toml --out DIR

Writes DIR/results.json, results.csv, results.md, plots, pictures and report.html (docs/evaluation.md). What is done is
kept in DIR/cache: an interrupted run goes on when it is started again, and only what changed is computed anew.
"""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from ngpt.system.console import Console, run_command


def main(arguments: list[str] | None = None) -> int:
    return run_command(lambda: run(arguments), interrupted="interrupted; the same command goes on from here")


def run(arguments: list[str] | None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True, metavar="TOML")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="SCENE", help="further scenes, files or patterns")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="stacks and cells (default: OUT/cache)")
    parser.add_argument("--advice", type=Path, metavar="FILE", help="also write the table that `ngpt advise` reads")
    parser.add_argument("-q", "--quiet", action="store_true", help="say nothing but errors")
    args = parser.parse_args(arguments)
    console = Console(args.quiet)
    command = shlex.join(["python", "eval.py", *(sys.argv[1:] if arguments is None else arguments)])
    # Here and not above: a mistyped option is said at once.
    from ngpt.evaluation.config import read_config
    from ngpt.evaluation.run import evaluate
    from ngpt.measure.advice import make_table
    from ngpt.report.evaluation import write_evaluation_report
    from ngpt.system.writing import write_json

    config = read_config(args.config)
    config = replace(config, scenes=(*config.scenes, *args.scenes))
    results = evaluate(config, args.out, console, command, args.cache)
    write_evaluation_report(args.out, args.out / "report.html", overwrite=True)
    if args.advice:
        write_json(args.advice, make_table(results))
    absent = [name for name, entry in results["scenes"].items() if entry.get("absent")]
    if absent:
        console.error(f"{len(absent)} of {len(results['scenes'])} scenes are absent: {', '.join(absent)}")
    console.say(f"{args.out}/results.md, {args.out}/report.html")
    return 1 if absent else 0


if __name__ == "__main__":
    sys.exit(main())
