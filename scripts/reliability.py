"""docs/lab/RELIABILITY.md: runs the campaigns, which leave a JSON file each, and writes the page of what came out.

python scripts/reliability.py                 what `make campaigns` runs: all campaigns, then the page
python scripts/reliability.py --from DIR      only the page, of the files in DIR
python scripts/reliability.py -k "kill or disk"    some of the campaigns, as pytest chooses them, then the page of them
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
CAMPAIGNS = "tests/campaigns"
PAGE = ROOT / "docs" / "lab" / "RELIABILITY.md"

# Campaigns of one kind share a row: what comes before one of these words is the kind
KINDS = (" at random moments of ", " under ")

HEAD = """\
# Reliability

`make campaigns` attacked ngpt {tried} times in {campaigns} campaigns, {date}. The table counts the outcomes, and all of
them are allowed. A campaign fails its test, and has no row, if there is a crash, a hang, a traceback, memory that
grows, or a half-written file under its final name.
{failure}
| campaign | tried | what came out | worst | seconds |
|---|---|---|---|---|
"""

TAIL = """
A killed process leaves at most one hidden file, `.ngpt-XXXXXXXX.SUFFIX`, for each file that it was writing. Nothing
reads it, and the next process that writes into the folder removes it. In the system's temporary folder, a killed
`data_gen` may leave `ngpt-scene-*`, and a `train.py` that renders its own crops `ngpt-stream-*`. The empty file `.lock`
stays in folders of training sets, runs and evaluations; the lock itself ends with its process.

Versions: {versions}.
"""


def run_campaigns(folder: Path, chosen: str | None) -> int:
    """Runs the long form of all campaigns; the exit status of pytest."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "slow", CAMPAIGNS] + (["-k", chosen] if chosen else [])
    return subprocess.run(command, cwd=ROOT, env=os.environ | {"NGPT_RELIABILITY": str(folder)}, check=False).returncode


def page(reports: list[dict], date: str, failed: bool) -> str:
    """The page, of what ``tests/reliability.py`` recorded."""
    versions: dict[str, set[str]] = {}
    for report in reports:
        for name, version in report["versions"].items():
            versions.setdefault(name, set()).add(version)
    head = HEAD.format(
        tried=f"{sum(report['tried'] for report in reports):,}",
        campaigns=len(reports),
        date=date,
        failure="\n**Of this run, some campaigns failed, and are missing here.**\n" if failed else "",
    )
    told = ", ".join(f"{name} {' and '.join(sorted(found))}" for name, found in sorted(versions.items()))
    return head + "".join(row(together(kind)) for kind in kinds(reports)) + TAIL.format(versions=told)


def kinds(reports: list[dict]) -> list[list[dict]]:
    """The reports, campaigns of one kind in one; see ``KINDS``."""
    found: dict[str, list[dict]] = {}
    for report in reports:
        kind = min((report["campaign"].partition(word)[0] for word in KINDS), key=len)
        found.setdefault(kind, []).append(report)
    return list(found.values())


def together(reports: list[dict]) -> dict:
    """One report of several of a kind: counts and seconds are added, of the worst numbers the largest counts."""
    if len(reports) == 1:
        return reports[0]
    name = reports[0]["campaign"]
    word = next(word for word in KINDS if word in name)
    what = ", ".join(report["campaign"].partition(word)[2].replace(",", "") for report in reports)
    total: dict = {"campaign": f"{name.partition(word)[0]}{word.rstrip(' :')}: {what}", "outcomes": {}, "worst": {}}
    total["tried"] = sum(report["tried"] for report in reports)
    total["seconds"] = sum(report["seconds"] or 0 for report in reports)
    for report in reports:
        for outcome, count in report["outcomes"].items():
            total["outcomes"][outcome] = total["outcomes"].get(outcome, 0) + count
        for measure, value in worst_of(report).items():
            total["worst"][measure] = larger(total["worst"].get(measure, value), value)
    return total


def larger(one: float | str, other: float | str) -> float | str:
    """The larger of two numbers, or two different texts after each other."""
    if isinstance(one, str) or isinstance(other, str):
        return one if str(other) in str(one) else f"{one}, {other}"
    return max(one, other)


def worst_of(report: dict) -> dict:
    """The worst that was measured, and all else that a campaign recorded."""
    known = {"campaign", "tried", "outcomes", "worst", "seconds", "versions"}
    return report["worst"] | {what: value for what, value in report.items() if what not in known}


def largest(worst: dict) -> dict:
    """The three largest of more than four measures, by the number that they begin with."""
    if len(worst) <= 4:
        return worst
    order = sorted(worst, key=lambda what: float(re.match(r"[\d.]*", str(worst[what]))[0] or 0), reverse=True)
    return {what: worst[what] for what in order[:3]}


def row(report: dict) -> str:
    outcomes = [f"{count:,} {what}" for what, count in report["outcomes"].items() if count]
    worst = [f"{what}: {value}" for what, value in largest(worst_of(report)).items()]
    seconds = "" if report["seconds"] is None else f"{report['seconds']:.0f}"
    cells = [report["campaign"], f"{report['tried']:,}", "; ".join(outcomes), "; ".join(worst), seconds]
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="folder", type=Path, metavar="DIR", help="use these files, and run nothing")
    parser.add_argument("-k", dest="chosen", metavar="EXPRESSION", help="run only these")
    parser.add_argument("-o", "--output", type=Path, default=PAGE, metavar="FILE", help=f"default: {PAGE}")
    args = parser.parse_args()
    from ngpt.system.writing import write_text

    with tempfile.TemporaryDirectory(prefix="ngpt-reliability-") as fresh:
        folder = args.folder or Path(fresh)
        status = 0 if args.folder else run_campaigns(folder, args.chosen)
        files = sorted(folder.glob("*.json"))
        reports = [json.loads(path.read_text()) for path in files]
        newest = max((path.stat().st_mtime for path in files), default=time.time())
    if not reports:
        print("reliability: no campaign left a record")
        return 1
    reports.sort(key=lambda report: report["campaign"])
    write_text(args.output, page(reports, time.strftime("%Y-%m-%d", time.gmtime(newest)), status != 0))
    print(f"reliability: {args.output}: {len(reports)} campaigns")
    return status


if __name__ == "__main__":
    sys.exit(main())
