"""``ngpt evaluate``: every method on the same scenes with the same clock."""

import argparse
from dataclasses import replace
from pathlib import Path

from ngpt.cli.arguments import add_config, config_of, write_template
from ngpt.errors import WrongUse
from ngpt.system import configs
from ngpt.system.console import Console


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Writes results.json, results.csv, pictures and report.html into DIR. The same command "
        "continues an interrupted run. After a change, only the results that depend on it are computed anew."
    )
    add_config(parser, configs.EVALUATION, "scenes, methods and metrics")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    parser.add_argument("--scenes", nargs="+", default=[], metavar="SCENE", help="more scenes: files or patterns")
    what = "folder for stacks and measurements, to share between runs (default: OUT/cache)"
    parser.add_argument("--cache", type=Path, metavar="DIR", help=what)


def run(args: argparse.Namespace, console: Console) -> int:
    path = config_of(args, configs.EVALUATION)
    if args.init:
        from ngpt.evaluation.config import EvaluationConfig
        from ngpt.system.records import read_toml
        from ngpt.system.templates import template

        if base := read_toml(path).get("base"):
            raise WrongUse(f"{path.stem} only changes numbers of {base}; give that file to --config")
        text = template(path.read_text(encoding="utf-8"), {"": EvaluationConfig})
        return write_template(args, text, "evaluate", console)
    if not args.out:
        raise WrongUse("--out is missing: the folder of the results")
    # Imported here, so that a mistyped option is reported at once.
    from ngpt.evaluation.config import read_config
    from ngpt.evaluation.run import evaluate
    from ngpt.report.evaluation import write_evaluation_report
    from ngpt.report.page import oversize
    from ngpt.system.parts import find_renderer

    config = read_config(path)
    config = replace(config, scenes=(*config.scenes, *args.scenes))
    results = evaluate(config, args.out, console, args.command, find_renderer(), args.cache)
    page = write_evaluation_report(args.out, args.out / "report.html", overwrite=True)
    if large := oversize(page):
        console.say(large)
    absent = [name for name, entry in results["scenes"].items() if entry.get("absent")]
    if absent:
        console.error(f"{len(absent)} of {len(results['scenes'])} scenes are absent: {', '.join(absent)}")
    console.say(f"{args.out}/results.csv, {args.out}/report.html")
    return 1 if absent else 0
