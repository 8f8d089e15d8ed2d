"""Makes text safe to show: names from files may control a terminal, or hide and reverse text."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape

from ngpt.errors import NgptError

# Invisible letters that Python counts as printable: fillers, joiners and variation selectors
# [Unicode 15, property Default_Ignorable_Code_Point]
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\ufff0-\ufff8\U000e0000-\U000e0fff]"
)

# Path of a temporary file -> its name in messages, such as "standard input"
_names: dict[str, str] = {}


@contextmanager
def called(path: str, name: str) -> Iterator[None]:
    """In the block, messages and results give the file ``path`` this ``name``. So do errors that leave the block."""
    _names[path] = name
    try:
        yield
    except NgptError as error:
        raise type(error)(by_names(str(error))) from error
    finally:
        del _names[path]


def by_names(text: str) -> str:
    """The text, with paths replaced by the names that ``called`` gives them."""
    for path, name in _names.items():
        text = text.replace(path, name)
    return text


def printable(text: str) -> str:
    """The text as one line in which all letters are visible and in order.

    Control characters, line breaks, marks of direction (U+202E reverses the text after it) and invisible letters become
    Python's escapes, such as ``\\x1b`` and ``\\u202e``. Paths are replaced as in ``by_names``.
    """
    text = by_names(text)
    return "".join(
        letter if letter.isprintable() and not _INVISIBLE.match(letter) else letter.encode("unicode_escape").decode()
        for letter in text
    )


def markup(text: str) -> str:
    """The ``printable`` text, escaped for HTML, as text or as the value of an attribute."""
    return escape(printable(text))
