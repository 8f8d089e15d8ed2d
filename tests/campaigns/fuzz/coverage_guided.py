"""Coverage-guided fuzzing of what is parsed in Python: bytes that reach new lines of ngpt breed others (libFuzzer).

    python tests/campaigns/fuzz/coverage_guided.py header -runs=100000      target, then libFuzzer's own arguments
    python tests/campaigns/fuzz/coverage_guided.py json crash-...           one input again

Targets: header (OpenEXR), json (manifests), toml (settings). Needs atheris, of PyPI, for Python up to 3.13.
"""

import os
import sys
import tempfile
import tomllib
from pathlib import Path

import atheris

with atheris.instrument_imports(
    include=["ngpt.io", "ngpt.system.records", "ngpt.training.dataset", "ngpt.training.settings"]
):
    from ngpt.errors import NgptError
    from ngpt.io.header import read_headers
    from ngpt.training.dataset import read_manifest
    from ngpt.training.settings import read_settings

from data_mutations import to_json
from exr_mutations import seeds
from targets import CONFIGS, _dataset


def header(path: Path) -> None:
    with open(path, "rb") as file:
        read_headers(file, str(path))


def settings(path: Path) -> None:
    try:
        tomllib.loads(path.read_bytes().decode())
    except RecursionError:
        return  # counted by the parser in Python frames, of which the instrumentation makes more
    except ValueError:
        pass
    read_settings(path)


TARGETS = {
    "header": (header, "a.exr", [data[:2000] for data in seeds()]),
    "json": (lambda path: read_manifest(path.parent), "manifest.json", [to_json(_dataset()[0])]),
    "toml": (settings, "a.toml", [(CONFIGS / f"{name}.toml").read_bytes() for name in ("fast", "paper")]),
}


def main() -> None:
    name, *arguments = sys.argv[1:]
    read, file, examples = TARGETS[name]
    folder = Path(tempfile.mkdtemp(prefix="ngpt-fuzz-"))
    corpus = folder / "corpus"
    corpus.mkdir()
    for i, data in enumerate(examples):
        (corpus / str(i)).write_bytes(data)
    path = folder / file

    def one(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read(path)
        except NgptError as error:
            assert str(folder) in str(error) and "\n" not in str(error)

    given = any(os.path.exists(argument) for argument in arguments)
    limits = ["-timeout=5", "-rss_limit_mb=1024", "-max_len=20000", f"-artifact_prefix={os.getcwd()}/"]
    atheris.Setup([sys.argv[0], *limits, *arguments, *([] if given else [str(corpus)])], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
