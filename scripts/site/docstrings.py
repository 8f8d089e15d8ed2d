"""Docstrings as the site shows them: lines that begin with the name of an argument become items of a list."""

import re

import griffe

ITEM = re.compile(r"^(``\w+``(?:, ``\w+``)*),? +(?!is\b)(?=\S)")


class Lists(griffe.Extension):
    def on_object(self, *, obj, **kwargs):
        if obj.docstring:
            lines, inside = [], False
            for line in obj.docstring.value.split("\n"):
                item = ITEM.match(line)
                # A list needs an empty line before its first item, and its items' further lines an indent
                if item and not inside:
                    lines.append("")
                inside = bool(item) or (inside and line.startswith(" "))
                text = f"- {item[1]}: {line[item.end() :]}" if item else line.strip() if inside else line
                lines.append("    " + text if inside and not item else text)
            obj.docstring.value = "\n".join(lines)
