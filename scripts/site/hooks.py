"""What the site adds to docs/: a menu, references of Python and commands, and what pages link to outside docs/.

The pages are written for the forge, where a link leads to any file of the repository. The site gets a copy of each such
file under ``repository/``, Markdown as a page, so that one link works in both places.
"""

import ast
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

from ngpt.cli import parsers

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
# Folder -> title in the menu
FOLDERS = {
    "start": "Start",
    "use": "Use",
    "methods": "Methods",
    "samplers": "Samplers",
    "train": "Train",
    "embed": "Embed",
    "api": "Python reference",
    "lab": "Lab",
}
LINK = re.compile(r"(\]\()(?![a-z]+:|#)([^)\s#]+)")
CSS = ".md-typeset table:not([class]) { font-size: .68rem } .md-grid { max-width: 70rem }"


def linked(page: Path) -> list[Path]:
    """Files and folders of the repository that a page links to."""
    return [(page.parent / target).resolve() for _, target in LINK.findall(page.read_text())]


def outside() -> set[Path]:
    """The files outside docs/ that a reader of docs/ can come to by links."""
    found: set[Path] = set()
    todo = list(DOCS.rglob("*.md"))
    while todo:
        for file in linked(todo.pop()):
            if file.is_file() and not file.is_relative_to(DOCS) and file not in found:
                found.add(file)
                todo += [file] if file.suffix == ".md" else []
    return found


def address(file: Path) -> str:
    """Where a file of the repository lies in the site's sources."""
    return str(file.relative_to(DOCS)) if file.is_relative_to(DOCS) else f"repository/{file.relative_to(ROOT)}"


def reference() -> dict[str, str]:
    """Pages of the Python reference: the public names of both packages, where they are defined."""
    pages = {}
    for package in ("ngpt", "data_gen"):
        homes = {}
        for node in ast.walk(ast.parse((ROOT / package / "__init__.py").read_text())):
            if isinstance(node, ast.ImportFrom) and node.module != f"{package}.version":
                homes |= {
                    alias.name: node.module for alias in node.names if f"{node.module}.".startswith(f"{package}.")
                }
        blocks = [f"::: {homes[name]}.{name}" for name in sorted(homes, key=str.lower)]
        pages[package] = "\n\n".join([f"# {package}", *blocks])
    return pages


def commands() -> str:
    """What the ``--help`` of each verb says, as a page."""
    texts = [f"## {name}\n\n```text\n{parser.format_help().rstrip()}\n```" for name, parser in parsers().items()]
    return "\n\n".join(["# Commands", "What `ngpt VERB --help` prints.", *texts]) + "\n"


def on_files(files, config):
    for file in sorted(outside()):
        files.append(File.generated(config, address(file), abs_src_path=str(file)))
    for name, text in reference().items():
        files.append(File.generated(config, f"api/{name}.md", content=text))
    files.append(File.generated(config, "use/commands.md", content=commands()))
    files.append(File.generated(config, "site.css", content=CSS))
    config.nav = menu([file.src_uri for file in files.documentation_pages()])
    return files


def menu(pages: list[str]) -> list:
    """The front page, pages beside it, then pages by folder, in the order in which the front page names them."""
    front = [address((DOCS / target).resolve()) for _, target in LINK.findall((DOCS / "index.md").read_text())]
    order = {page: place for place, page in reversed(list(enumerate(front)))}
    of = {folder: [page for page in pages if page.startswith(folder + "/")] for folder in FOLDERS}
    beside = [page for page in pages if "/" not in page and page != "index.md"]
    for chosen in (beside, *of.values()):
        chosen.sort(key=lambda page: (order.get(page, len(front)), page))
    return ["index.md", *beside, *({FOLDERS[folder]: chosen} for folder, chosen in of.items() if chosen)]


def on_page_markdown(markdown, page, config, files):
    """Links of the forge become the site's; what is a folder there is no link here."""
    here = Path(page.file.abs_src_path).parent if page.file.abs_src_path else DOCS / "api"

    def mended(match: re.Match) -> str:
        file = (here / match[2]).resolve()
        return match[1] + posixpath.relpath(address(file), posixpath.dirname(page.file.src_uri) or ".")

    folders = re.compile(r"(?<!!)\[([^\]]+)\]\(((?!#|[a-z]+:)[^)\s#]+)\)")
    markdown = folders.sub(lambda match: match[1] if (here / match[2]).is_dir() else match[0], markdown)
    return LINK.sub(mended, markdown)
