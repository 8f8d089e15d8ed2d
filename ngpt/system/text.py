"""Text of elsewhere, fit to be shown: names in files may hold what controls a terminal, or hides and turns text."""

import re
from html import escape

# Letters that show nothing, of those that Python counts as printable: fillers, joiners and selectors of variants.
# [Unicode 15, property Default_Ignorable_Code_Point]
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\ufff0-\ufff8\U000e0000-\U000e0fff]"
)


def printable(text: str) -> str:
    """One line of text in which every letter is seen, and in its place.

    Control characters, line breaks, marks of direction (U+202E turns what follows around) and letters that show nothing
    become what Python writes for them, ``\\x1b`` and ``\\u202e``.
    """
    if text.isprintable() and not _INVISIBLE.search(text):
        return text
    return "".join(
        letter if letter.isprintable() and not _INVISIBLE.match(letter) else letter.encode("unicode_escape").decode()
        for letter in text
    )


def markup(text: str) -> str:
    """The same as part of a page, text or the value of an attribute."""
    return escape(printable(text))
