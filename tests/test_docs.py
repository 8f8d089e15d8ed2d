"""The pages hold what they promise: links, commands, pictures, tables and examples."""

import json
import re
import shlex
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import pytest
from verbs import parser_of

import ngpt
from ngpt.cli import all_verbs

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("export/**/*.md")])
PAGES += sorted(ROOT.glob("studies/*.md"))
PAGES = [page for page in PAGES if "node_modules" not in page.parts]
NOTEBOOKS = sorted(ROOT.glob("docs/**/*.ipynb"))


def name(page):
    return str(page.relative_to(ROOT))


# The log says what was run, with the programs of its day.
TODAY = [page for page in PAGES if not name(page).startswith("docs/lab/log/")]
each_page = pytest.mark.parametrize("page", TODAY, ids=name)


def text_of(page):
    if page.suffix == ".md":
        return page.read_text()
    return "".join(line for cell in json.loads(page.read_text())["cells"] for line in cell["source"])


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name)
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", text_of(page))
    assert targets or page.suffix == ".md"
    for target in targets:
        file, _, anchor = target.partition("#")
        if not re.match(r"[a-z]+:", target):
            other = (page.parent / file).resolve() if file else page
            assert other.exists(), target
            assert not anchor or anchor in anchors(other), target


@each_page
def test_commands_exist(page):
    text = page.read_text()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    # As code only: prose may well "make test sets".
    assert set(re.findall(r"(?:`|^ {4})make ([a-z-]+)", text, re.M)) <= targets
    assert set(re.findall(r"(?:`|^ {4})ngpt ([a-z]+)", text, re.M)) <= all_verbs().keys()
    modules = re.findall(r"python -m ([a-z_.]+[a-z_])", text)
    assert [module for module in modules if find_spec(module) is None] == []
    files = re.findall(r"python ((?:[\w-]+/)*[\w-]+\.py)", text)
    assert [file for file in files if not (ROOT / file).is_file()] == []
    for config in re.findall(r"--config (?:configs/)?([a-z0-9-]+)(?:\.toml)?\b(?!\*)", text):
        assert list(ROOT.glob(f"configs/{config}*.toml")), config


def settings_of(verb):
    """Names that -O may set: options of samplers where something is rendered, else of methods."""
    from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
    from ngpt.methods import METHODS

    entries = {**SAMPLERS, **FRAME_SAMPLERS} if verb == "render" else METHODS
    return {name for entry in entries.values() for name in entry.options} | {"NAME", "name"}


def unknown_options(line):
    """Options in a piece of a command line that its verb does not have."""
    _, verb, *words = shlex.split(re.sub(r"[\[\]]|\.\.\.", " ", line), comments=True)
    known = {"-h", "--help", *parser_of(verb)._option_string_actions}
    given = [word.partition("=")[0] for word in words if re.match(r"--?[a-zA-Z]", word)]
    for flag, setting in pairwise(words):
        assert flag != "-O" or setting.partition("=")[0] in settings_of(verb), line
    return [word for word in given if word not in known]


@each_page
def test_command_lines_are_accepted(page):
    text = page.read_text().replace("\\\n", " ")
    # Blocks of code: fenced, and lines that are indented.
    code = [*re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S), *re.findall(r"^ {4}(.*)$", text, re.M)]
    for line in re.findall(r"^ *(ngpt [a-z]+ .*)$", "\n".join(code), re.M):
        if "--method median" in line:  # of the page on adding a method
            continue
        if "..." not in line and "[" not in line.partition("#")[0]:
            _, verb, *words = shlex.split(line, comments=True)
            try:
                parser_of(verb).parse_args(words)
            except SystemExit as left:
                assert left.code == 0, line
        assert unknown_options(line) == [], line
    for line in re.findall(r"`(ngpt [a-z]+ [^`]*)`", text):
        assert unknown_options(line) == [], line


def test_command_lines_of_messages_are_accepted():
    """What an error or a help text tells to type: each `ngpt ...` between backquotes in the code."""
    files = [*ROOT.glob("ngpt/**/*.py"), *ROOT.glob("data_gen/**/*.py")]
    texts = {file: re.sub(r'" *\n\s*f?"', "", file.read_text()) for file in files}
    lines = [(file, line) for file in files for line in re.findall(r"`(ngpt [a-z]+[^`\n]*)`", texts[file])]
    assert len(lines) > 20
    assert [found for found in lines if unknown_options(found[1].replace("'", ""))] == []


def test_tables_are_those_of_their_files():
    """They are written by `python -m bench.pages`, `bench.tables` and `bench.gallery`."""
    from bench import gallery, pages, tables

    blocks = pages.blocks(json.loads(pages.RESULT.read_text())).items()
    found = {(page, block): (pages.marks(block), text) for (page, block), text in blocks}
    found |= {(page, of): (tables.marks(of), tables.table(of)) for of, (page, _) in tables.PAGES.items()}
    found[gallery.PAGE, "gallery"] = gallery.MARKS, gallery.table(json.loads(gallery.RESULT.read_text()))
    assert [
        where
        for where, ((start, end), text) in found.items()
        if f"{start}\n\n{text}\n\n{end}" not in (ROOT / where[0]).read_text()
    ] == []


def test_the_readme_is_short_and_its_numbers_are_in_the_results():
    readme, results = ((ROOT / page).read_text() for page in ("README.md", "docs/lab/RESULTS.md"))
    # What is read is counted: no pipes and rules of tables.
    assert len([word for word in readme.split() if re.search(r"\w", word)]) <= 900
    for number in re.findall(r"\b0\.\d{4}\b", readme):
        assert number in results, number
    for pair in re.findall(r"\b\d+ of \d+\b", readme):
        assert pair in results, pair


@pytest.fixture
def blocks_of(tmp_path, monkeypatch):
    """The blocks of Python on a page, and an empty folder to run them in."""
    monkeypatch.chdir(tmp_path)
    return lambda page: re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "use" / page).read_text(), re.S)


def test_the_example_of_a_renderer_runs(blocks_of):
    """The first block of Python, and what follows from it."""
    made: dict = {}
    exec(blocks_of("from-your-renderer.md")[0], made)
    stack = ngpt.read("stack.exr")
    assert {"primal", "dx", "dy", "primal_var"} <= set(stack.names)
    assert made["image"].shape == stack["primal"].shape


def test_the_examples_of_python_run(blocks_of):
    """Arrays and files; that of Mitsuba is in tests/api/test_denoiser.py."""
    blocks, made = blocks_of("python.md"), {}
    exec(blocks[0], made)
    assert made["clean"].shape == made["noisy"].shape
    exec(blocks[2] + blocks[3], made)
    assert made["stack"]["primal"].shape == made["noisy"].shape


@pytest.mark.slow
def test_the_example_of_rendering_runs(renderer, blocks_of, tmp_path):
    blocks, made = blocks_of("python.md"), {}
    exec(blocks[4], made)
    assert made["image"].shape == (48, 64, 3) and len(list(tmp_path.iterdir())) == 4
    exec(blocks[5], made)
    assert {"primal", "dx", "primal_var"} <= set(made["stack"].names)
