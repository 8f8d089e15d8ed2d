"""The house: rooms stand on rooms below them, no import leads up, and none in a circle.

Imports inside functions count like those at the top: what is late is quick to start, not independent.
"""

import ast
from collections.abc import Iterable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]

# From the ground up; rooms of one line do not know each other. A room is a folder and all in it, or a file that lies
# open in ngpt or data_gen.
FLOORS = """
ngpt.errors ngpt.version
ngpt.system ngpt.options ngpt.windows ngpt.layers ngpt.testing ngpt.shared ngpt.subpixels
ngpt.image
ngpt.stack
ngpt.io ngpt.repair ngpt.coverage ngpt.magnitude ngpt.panorama ngpt.renderer
ngpt.classical ngpt.merging
ngpt.denoisers
ngpt.network
ngpt.methods
ngpt.result_file
ngpt.sequence
ngpt.api ngpt.measure
ngpt.report
ngpt.training ngpt.evaluation
ngpt.export
ngpt.cli
data_gen.scenes data_gen.budget data_gen.llvm data_gen.cluster data_gen.pattern
data_gen.paths data_gen.film
data_gen.passes data_gen.tails
data_gen.samplers
data_gen.adaptive data_gen.plugins data_gen.caustics
data_gen.inspect data_gen.backend
data_gen.request
data_gen.begun
data_gen.render
data_gen.frames data_gen.choosing
data_gen.dataset data_gen.session data_gen.code
data_gen.outputs data_gen.service
data_gen.shot_files
data_gen.cli
ngpt data_gen
ngpt.__main__ data_gen.__main__ train eval export ngpt_studies
bench
scripts
"""

# What makes data sets, trains and compares, and the verbs that are doors to it: what renders, denoises and exports does
# without. `ngpt info` and `ngpt report` describe its folders too.
LAB = ("ngpt.training", "ngpt.evaluation", "data_gen.dataset")
DOORS = {f"ngpt.cli.{verb}" for verb in ("train", "evaluate", "info", "report")} | {"data_gen.cli.dataset"}


def modules(root: Path) -> dict[str, Path]:
    """Name -> file of all code but the tests'."""
    folders = [root / name for name in ("ngpt", "data_gen", "export", "bench", "scripts", "studies/ngpt_studies")]
    files = [file for folder in folders for file in folder.rglob("*.py") if "node_modules" not in file.parts]
    files += [root / "train.py", root / "eval.py"]
    names = {".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): file for file in files}
    return {name.removeprefix("studies."): file for name, file in names.items() if file.exists()}


def imports(name: str, file: Path, known: dict[str, Path]) -> set[str]:
    """The modules that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
    return (found & known.keys()) - {name}


def floor_of(name: str) -> tuple[int, str]:
    """The floor and the room of a module."""
    # The face of a package is a room of its own: it hands on what all others have.
    package, *rest = name.split(".")
    room = f"{package}.{rest[0]}" if rest and package in ("ngpt", "data_gen") else package
    floors = [floor for floor, line in enumerate(FLOORS.strip().splitlines()) if room in line.split()]
    assert len(floors) == 1, f"{room} stands on {len(floors)} floors: give it one in FLOORS"
    return floors[0], room


def faults(graph: dict[str, set[str]]) -> list[str]:
    """What is wrong with a house, a line each: arrows up, arrows between rooms of one floor, a circle of files."""
    wrong = []
    for name, targets in sorted(graph.items()):
        floor, room = floor_of(name)
        for target in sorted(targets):
            below, other = floor_of(target)
            if below > floor or (below == floor and other != room):
                wrong.append(f"{name} imports {target}, which does not stand below it")
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        wrong.append(f"a circle: {' -> '.join(error.args[1])}")
    return wrong


def is_in(name: str, rooms: Iterable[str]) -> bool:
    return any(name == room or name.startswith(f"{room}.") for room in rooms)


def of_the_lab(graph: dict[str, set[str]]) -> list[str]:
    """The imports by which what renders, denoises or exports would need the lab."""
    core = [name for name in graph if is_in(name, ("ngpt", "data_gen")) and not is_in(name, LAB) and name not in DOORS]
    return [f"{name} imports {target}" for name in core for target in sorted(graph[name]) if is_in(target, LAB)]


MODULES = modules(ROOT)
GRAPH = {name: imports(name, file, MODULES) for name, file in MODULES.items()}


def test_every_import_leads_down():
    assert not faults(GRAPH)


def test_what_renders_denoises_and_exports_never_imports_the_lab():
    assert not of_the_lab(GRAPH)
    assert not [name for name in DOORS if not any(is_in(target, LAB) for target in GRAPH[name])]
    assert of_the_lab(GRAPH | {"ngpt.stack": {"ngpt.training.loss"}}) == ["ngpt.stack imports ngpt.training.loss"]


def test_nothing_but_benchmarks_imports_the_studies():
    """They stand on what any other package can use."""
    wrong = {name for name, targets in GRAPH.items() if any(is_in(target, ["ngpt_studies"]) for target in targets)}
    assert {name for name in wrong if not is_in(name, ("ngpt_studies", "bench"))} == set()
