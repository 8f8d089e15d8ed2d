"""What we depend on: its licences, its known vulnerabilities, and the hashes of its files.

    python scripts/supply.py check    what `make check` runs: licences, vulnerabilities, whether the hashes are current
    python scripts/supply.py lock     writes constraints-hashes.txt anew, after constraints.txt has changed

Licences and hashes are of what is installed here, which `make check` sees to.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
import urllib.request
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
CONSTRAINTS, LOCK = ROOT / "constraints.txt", ROOT / "constraints-hashes.txt"
API = "https://pypi.org/pypi/{name}/{version}/json"

# Parts of SPDX expressions, classifiers and free texts that stand for licences without copyleft.
PERMISSIVE = (
    r"0BSD|Apache( Software License|[ -]2\.0)?( WITH LLVM-exception)?|BSL-1\.0|CC0-1\.0|ISC|MIT(-CMU| License)?"
    r"|PSF-2\.0|(3-Clause )?BSD(-[23]-Clause)?( License)?|Zlib"
)

# Where the metadata say too little: the licence, and how we know.
KNOWN = {"openexr": "BSD-3-Clause: by LICENSE.md in its wheel"}

# Come with CUDA builds of torch only, which we do not ask for: NVIDIA's own terms hold for them.
_OF_CUDA = re.compile(r"(nvidia|cuda|triton)\b.*")

HEADER = """\
# The files that constraints.txt stands for, by their hashes: Linux x86-64, Python 3.11.
# Made by `python scripts/supply.py lock`.
#
#     pip install --require-hashes --no-deps -r constraints-hashes.txt && pip install --no-deps -e .
#
# Beside constraints.txt and not in it: once one line has a hash, pip wants them for all it installs, and our own
# package, installed as it lies here, can have none. torch is left out: its CPU build comes from PyTorch's own index, or
# a wheel on the machine, and PyPI's file of that version is another one; install it first, from where you trust.
"""


def closure(extras: set[str]) -> dict[str, Distribution]:
    """The distributions that ngpt and these extras of it need, by canonical name; fails if one is not installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    todo = [Requirement(line) for line in project["dependencies"]]
    todo += [Requirement(line) for extra in extras for line in optional[extra]]
    found: dict[str, Distribution] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    while todo:
        wanted = todo.pop()
        name, key = canonicalize_name(wanted.name), (canonicalize_name(wanted.name), frozenset(wanted.extras))
        if name == project["name"]:
            todo += [Requirement(line) for extra in wanted.extras for line in optional[extra]]
        elif key not in seen and not _OF_CUDA.fullmatch(name):
            seen.add(key)
            try:
                found[name] = distribution(name)
            except PackageNotFoundError:
                sys.exit(f"supply: {name} is not installed; run `make check`, which installs what is checked")
            environments = [{"extra": extra} for extra in wanted.extras or {""}]
            for one in map(Requirement, found[name].requires or []):
                if one.marker is None or any(one.marker.evaluate(environment) for environment in environments):
                    todo.append(one)
    return dict(sorted(found.items()))


def runtime() -> dict[str, Distribution]:
    """What users of ngpt may have to install: everything but the tools of its developers."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return closure(set(project["optional-dependencies"]) - {"dev", "docs"})


def licence(package: Distribution) -> str:
    """What its metadata say: an SPDX expression, else a classifier, else the first line of a text."""
    told = package.metadata
    if expression := told.get("License-Expression"):
        return expression
    classifiers = [c.split(" :: ")[-1] for c in told.get_all("Classifier", []) if c.startswith("License ::")]
    text = (told.get("License") or "").strip()
    return " AND ".join(classifiers) or text.partition("\n")[0] or "unknown"


def permissive(expression: str) -> bool:
    """Whether one may use it so that no part of it is under copyleft: of alternatives one is enough."""
    parts = re.split(r"\s+AND\s+", expression.replace("(", "").replace(")", ""))
    return all(any(re.fullmatch(PERMISSIVE, one.strip()) for one in re.split(r"\s+OR\s+", part)) for part in parts)


def check_licences(packages: dict[str, Distribution]) -> bool:
    refused = []
    for name, package in packages.items():
        told = licence(package)
        if name in KNOWN and told == "unknown":
            told = KNOWN[name]
        elif not permissive(told):
            refused.append(f"{name} {package.version}: {told}")
        print(f"{name:24} {package.version:14} {told}")
    for line in refused:
        print(f"supply: licence is copyleft or unknown, and not listed with a reason in {__file__}: {line}")
    return not refused


def check_vulnerabilities(packages: dict[str, Distribution]) -> bool:
    """Asks PyPI; where it cannot be asked, says so, and that is no failure."""
    found = asked = 0
    for name, package in packages.items():
        version = package.version.partition("+")[0]
        try:
            with urllib.request.urlopen(API.format(name=name, version=version), timeout=20) as answer:
                known = json.load(answer)["vulnerabilities"]
        except (OSError, ValueError, KeyError) as error:
            print(f"supply: vulnerabilities NOT checked: PyPI's JSON interface does not answer for {name}: {error}")
            break
        asked += 1
        for one in known:
            if not one.get("withdrawn"):
                found += 1
                print(f"supply: {name} {version}: {one['id']}, fixed in {', '.join(one['fixed_in']) or 'no version'}")
    print(f"supply: {asked} of {len(packages)} packages asked for, {found} known vulnerabilities")
    return not found


def pinned(path: Path) -> dict[str, str]:
    """Names and versions of a requirements file."""
    lines = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", path.read_text(), re.M)
    return {canonicalize_name(name): version for name, version in lines}


def check_lock(packages: dict[str, Distribution]) -> bool:
    constraints, lock = pinned(CONSTRAINTS), pinned(LOCK)
    wrong = [f"{name} has no version in {CONSTRAINTS.name}" for name in packages if name not in constraints]
    wrong += [
        f"{name} is {constraints.get(name)} in {CONSTRAINTS.name} and {lock.get(name)} in {LOCK.name}"
        for name in sorted((constraints | lock).keys() - {"torch"})
        if constraints.get(name) != lock.get(name)
    ]
    for line in wrong:
        print(f"supply: {line}; mend it, and run `python scripts/supply.py lock`")
    return not wrong


def write_lock() -> None:
    """Asks pip which file it takes for each line of constraints.txt, from the index it is set up with."""
    wanted = [f"{name}=={version}" for name, version in pinned(CONSTRAINTS).items() if name != "torch"]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps"]
        subprocess.run([*command, "--only-binary", ":all:", "--report", str(report), *wanted], check=True)
        entries = json.loads(report.read_text())["install"]
    lines = []
    for entry in sorted(entries, key=lambda entry: canonicalize_name(entry["metadata"]["name"])):
        name, version = canonicalize_name(entry["metadata"]["name"]), entry["metadata"]["version"]
        lines.append(f"{name}=={version} --hash=sha256:{entry['download_info']['archive_info']['hashes']['sha256']}")
    LOCK.write_text(HEADER + "\n".join(lines) + "\n")
    print(f"supply: {LOCK.name}: {len(lines)} files")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["check", "lock"])
    if parser.parse_args().what == "lock":
        write_lock()
        return 0
    packages = runtime()
    results = [check_licences(packages), check_lock(closure({"dev", "docs"})), check_vulnerabilities(packages)]
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
