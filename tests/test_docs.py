"""The pages hold what they promise: links, commands, pictures, tables and examples."""

import json
import re
import shlex
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import pytest
from verbs import parser_of

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("export/**/*.md")])
PAGES = [page for page in PAGES if "node_modules" not in page.parts]


def name(page):
    return str(page.relative_to(ROOT))


def anchors(page):
    """The anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        other = (page.parent / file).resolve() if file else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other), target


# The log says what was run, with the programs of its day.
TODAY = [page for page in PAGES if not re.match(r"docs/lab/(LOG|log/)", name(page))]


@pytest.mark.parametrize("page", TODAY, ids=name)
def test_commands_exist(page, capsys):
    from ngpt.cli import main

    text = page.read_text()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    # As code only: prose may well "make test sets".
    for target in re.findall(r"(?:`|^ {4})make ([a-z-]+)", text, re.M):
        assert target in targets, f"make {target}"
    for module in re.findall(r"python -m ([a-z_.]+[a-z_])", text):
        assert find_spec(module) is not None, f"python -m {module}"
    for file in re.findall(r"python ((?:[\w-]+/)*[\w-]+\.py)", text):
        assert (ROOT / file).is_file(), file
    with pytest.raises(SystemExit):
        main(["--help"])
    verbs = set(re.findall(r"^ {2,4}([a-z]+)(?: {2}|$)", capsys.readouterr().out, re.M))
    for verb in re.findall(r"(?:`|^ {4})ngpt ([a-z]+)", text, re.M):
        assert verb in verbs, f"ngpt {verb}"


def unknown_options(line):
    """Options in a piece of a command line that its verb does not have."""
    _, verb, *words = shlex.split(line, comments=True)
    known = {"-h", "--help", *parser_of(verb)._option_string_actions}
    given = [word.partition("=")[0] for word in words if re.match(r"--?[a-zA-Z]", word)]
    for flag, setting in pairwise(words):
        assert flag != "-O" or setting.partition("=")[0] in settings_of(verb), line
    return [word for word in given if word not in known]


@pytest.mark.parametrize("page", TODAY, ids=name)
def test_command_lines_are_accepted(page):
    text = page.read_text().replace("\\\n", " ")
    for line in re.findall(r"^ *(ngpt [a-z]+ .*)$", "\n".join(code_of(text)), re.M):
        words = shlex.split(line, comments=True)[1:]
        if "..." in line or "[" in line.partition("#")[0]:
            assert unknown_options(re.sub(r"[\[\]]|\.\.\.", " ", line)) == [], line
            continue
        if "--method median" in line:  # of the page on adding a method
            continue
        try:
            parser_of(words[0]).parse_args(words[1:])
        except SystemExit as left:
            assert left.code == 0, line
        assert unknown_options(line) == [], line
    for line in re.findall(r"`(ngpt [a-z]+ [^`]*)`", text):
        assert unknown_options(re.sub(r"[\[\]]|\.\.\.", " ", line)) == [], line


def settings_of(verb):
    """Names that -O may set: options of samplers where something is rendered, else of methods."""
    from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
    from ngpt.methods import METHODS

    entries = {**SAMPLERS, **FRAME_SAMPLERS} if verb == "render" else METHODS
    return {name for entry in entries.values() for name in entry.options} | {"NAME", "name"}


def code_of(text):
    """Blocks of a page: fenced, and lines that are indented."""
    return [*re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S), *re.findall(r"^ {4}(.*)$", text, re.M)]


def test_command_lines_of_messages_are_accepted():
    """What an error or a help text tells to type: each `ngpt ...` between backquotes in the code."""
    found = 0
    for file in [*ROOT.glob("ngpt/**/*.py"), *ROOT.glob("data_gen/**/*.py")]:
        for line in re.findall(r"`(ngpt [a-z]+[^`\n]*)`", re.sub(r'" *\n\s*f?"', "", file.read_text())):
            assert unknown_options(line.replace("'", "")) == [], (file, line)
            found += 1
    assert found > 20


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_configurations_exist(page):
    for config in re.findall(r"--config (?:configs/)?([a-z0-9-]+)(?:\.toml)?\b(?!\*)", page.read_text()):
        assert list(ROOT.glob(f"configs/{config}*.toml")), config


def test_the_tables_of_the_main_evaluation_are_those_of_its_file():
    """`python -m bench.pages` writes them."""
    from bench.pages import RESULT, blocks, marks

    for (page, name), text in blocks(json.loads(RESULT.read_text())).items():
        start, end = marks(name)
        assert f"{start}\n\n{text}\n\n{end}" in (ROOT / page).read_text(), (page, name)


def test_tables_of_evaluations_are_those_of_their_files():
    """`python -m bench.tables` writes them."""
    from bench.tables import PAGES as PAGES_OF_TABLES
    from bench.tables import marks, table

    for of, (page, _) in PAGES_OF_TABLES.items():
        start, end = marks(of)
        assert f"{start}\n\n{table(of)}\n\n{end}" in (ROOT / page).read_text(), of


def test_the_table_of_the_gallery_is_that_of_its_file():
    """`python -m bench.gallery` writes it; each scene has a picture and a heading."""
    from bench.gallery import MARKS, PAGE, RESULT, SCENES_SHOWN, name_of, table

    page = PAGE.read_text()
    assert f"{MARKS[0]}\n\n{table(json.loads(RESULT.read_text()))}\n\n{MARKS[1]}" in page
    assert re.findall(r"^## (\S+)$", page, re.M) == [name_of(row) for row in SCENES_SHOWN]
    assert re.findall(r"gallery/(\S+)\.webp", page) == [name_of(row) for row in SCENES_SHOWN]


def test_the_readme_is_short():
    """What is read is counted: no pipes and rules of tables."""
    words = [word for word in (ROOT / "README.md").read_text().split() if re.search(r"\w", word)]
    assert len(words) <= 900, len(words)


def test_the_numbers_of_the_readme_are_in_the_results():
    readme, results = ((ROOT / page).read_text() for page in ("README.md", "docs/lab/RESULTS.md"))
    hero = json.loads((ROOT / "bench" / "results" / "hero.json").read_text())["results"]
    measured = {f"{value:.4f}" for row in hero.values() for value in row.values() if isinstance(value, float)}
    for number in re.findall(r"\b0\.\d{4}\b", readme):
        assert number in results or number in measured, number
    for pair in re.findall(r"\b\d+ of \d+\b", readme):
        assert pair in results, pair


def test_the_example_of_a_renderer_runs(tmp_path, monkeypatch):
    """The first block of Python, and what follows from it."""
    import ngpt

    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "use" / "from-your-renderer.md").read_text(), re.S)
    made: dict = {}
    exec(blocks[0], made)
    stack = ngpt.read("stack.exr")
    assert {"primal", "dx", "dy", "primal_var"} <= set(stack.names)
    assert made["image"].shape == stack["primal"].shape


def test_the_examples_of_python_run(tmp_path, monkeypatch):
    """Arrays and files; that of Mitsuba is in tests/api/test_denoiser.py."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "use" / "python.md").read_text(), re.S)
    made: dict = {}
    exec(blocks[0], made)
    assert made["clean"].shape == made["noisy"].shape
    exec(blocks[2] + blocks[3], made)
    assert made["stack"]["primal"].shape == made["noisy"].shape


def test_the_example_of_rendering_runs(renderer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "use" / "python.md").read_text(), re.S)
    made: dict = {}
    exec(blocks[4], made)
    assert made["image"].shape == (48, 64, 3) and len(list(tmp_path.iterdir())) == 4
    exec(blocks[5], made)
    assert {"primal", "dx", "primal_var"} <= set(made["stack"].names)
