"""The rules of versions: one number, in one place, and a changelog that knows it.

python -m scripts.release.rules v0.1.0     fails unless that tag may be published
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
UNRELEASED = "unreleased"


def version() -> str:
    """The version in ngpt/version.py, which everything else reads."""
    found = re.search(r'^__version__ = "(.+)"$', (ROOT / "ngpt" / "version.py").read_text(), re.M)
    assert found, "ngpt/version.py names no version"
    return found[1]


def newest() -> tuple[str, str]:
    """The version and the date, or "unreleased", of the changelog's first heading."""
    found = re.search(r"^## (\S+) \((.+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    return (found[1], found[2]) if found else ("", "")


def problems(tag: str) -> list[str]:
    """What stands between a tag, "v1.2.3", and its release, a line each."""
    own, (listed, date) = version(), newest()
    wrong = []
    if tag != f"v{own}":
        wrong.append(f"the tag is {tag} and ngpt/version.py says {own}: the tag must be v{own}")
    if listed != own:
        wrong.append(f"CHANGELOG.md begins with {listed} and ngpt/version.py says {own}: give it a heading")
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", date):
        wrong.append(f"CHANGELOG.md says '{date}' of {listed}: write the day, as 2026-12-31")
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.M)
    if not cited or cited[1] != own:
        wrong.append(f"CITATION.cff is of another version than {own}")
    return wrong


def main() -> int:
    wrong = problems(sys.argv[1])
    for line in wrong:
        print(f"release: {line}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
