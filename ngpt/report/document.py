"""Makes pages of text, tables and plots in the report's style: single files without scripts that load nothing else."""

import base64
import hashlib
from importlib.resources import files as package_files

from ngpt.system.text import markup


def document(title: str, body: str, *, command: str = "", style: str = "", refresh: int = 0) -> str:
    """The HTML of a page.

    ``body``     markup
    ``style``    rules of CSS in addition to those of the report
    ``refresh``  seconds after which an open page is loaded again; 0: never
    """
    sheet = (package_files("ngpt.report") / "report.html").read_text(encoding="utf-8")
    sheet = sheet.split("<style>")[1].split("</style>")[0] + style
    allowed = source_hash(sheet)
    policy = f"default-src 'none'; img-src data:; style-src {allowed}; base-uri 'none'; form-action 'none'"
    again = f'<meta http-equiv="refresh" content="{refresh}">\n' if refresh else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en" data-ready="true">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta name="color-scheme" content="dark">\n{again}<title>{markup(title)}</title>\n'
        f"<style>{sheet}</style>\n</head>\n<body>\n<header><h1>{markup(title)}</h1></header>\n"
        f"<main>\n{body}\n</main>\n"
        f"<footer><code>{markup(command)}</code></footer>\n</body>\n</html>\n"
    )


def source_hash(body: str) -> str:
    """The hash of a style or a script for a page's Content-Security-Policy, which allows no other style or script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()}'"
