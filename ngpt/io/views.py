"""The views of a file: the eyes of a stereo camera, each with layers of its own.

| layout | the right eye's colour | what says so |
|---|---|---|
| OpenEXR's, one part | ``right.R``, ``albedo.right.R``; the first may lack its name | the attribute ``multiView`` |
| OpenEXR's, many parts | ``R`` in a part of its own | that part's attribute ``view`` |
| others | ``right.albedo.R`` | ``multiView``, or ``left`` and ``right`` in names that are otherwise equal |

Here the layers of a view are named without the view's name, ``albedo.R``, so that one search serves all layouts.
https://openexr.com/en/latest/MultiViewOpenEXR.html
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from ngpt.errors import NgptError
from ngpt.io.resolution import holds_colour

# Views that are recognised without an attribute (see ``_eyes``)
_EYES = ("left", "right")


class Part(NamedTuple):
    """A part of a file: its name, its channels, and its attributes ``view`` and ``multiView``."""

    name: str
    channels: Sequence[str]
    view: str = ""
    views: Sequence[str] = ()


class View(NamedTuple):
    """One view of a file.

    ``name``   "" in a file without views
    ``parts``  the name of each part of the file, and its channels: names without the view -> names in the file. Parts
               of other views have no channels
    ``infix``  the word to insert into the names of new channels; "" for the first view and for views with own parts
    """

    name: str
    parts: list[tuple[str, dict[str, str]]]
    infix: str = ""

    @property
    def first(self) -> int:
        """The first part with channels of this view."""
        return next(index for index, (_, channels) in enumerate(self.parts) if channels)

    def without(self, name: str) -> str:
        """The name of a layer, or of channels, without the name of this view: "right.albedo" becomes "albedo"."""
        word = re.escape(self.name)
        return re.sub(rf"\b{word}\.|\.{word}\b", "", name) if self.name else name

    def channel(self, part: int, name: str) -> str:
        """The name that a channel of this view has in the file, or would have if it existed."""
        known = self.parts[part][1] if part < len(self.parts) else {}
        layer, dot, suffix = name.rpartition(".")
        inserted = ".".join([*([layer] if dot else []), self.infix, suffix]) if self.infix else name
        return known.get(name, inserted)


def views_of(parts: Sequence[Part]) -> list[View]:
    """The views of a file that hold colour, in order; a single view without a name if the file names none."""
    names = list(dict.fromkeys([*(view for part in parts for view in part.views), *(p.view for p in parts if p.view)]))
    names = names or _eyes(parts)
    plain = View("", [(part.name, {channel: channel for channel in part.channels}) for part in parts])
    if len(names) < 2:
        return [plain]
    views = [View(name, [_of_view(part, name, names) for part in parts], _infix(parts, name, names)) for name in names]
    return [view for view in views if holds_colour(view.parts)] or [plain]


def choose_views(views: Sequence[View], wanted: str | None, path: str) -> list[View]:
    """The view called ``wanted``, or all views for None. Raises NgptError if the file has no such view."""
    if wanted is None:
        return list(views)
    if found := [view for view in views if view.name == wanted]:
        return found
    names = ", ".join(view.name for view in views)
    raise NgptError(f"{path}: has no view '{wanted}'; it has {names or 'only one, without a name'}")


def _eyes(parts: Sequence[Part]) -> list[str]:
    """Left and right, if each of them has a part of its own, or if they have a channel in common; otherwise none."""
    left, right = _EYES
    if {left, right} <= {part.name for part in parts}:
        return list(_EYES)
    words = [tuple(channel.split(".")) for part in parts for channel in part.channels]
    twins = {tuple(right if word == left else word for word in name) for name in words if left in name[:-1]}
    return list(_EYES) if twins & set(words) else []


def _of_view(part: Part, view: str, names: Sequence[str]) -> tuple[str, dict[str, str]]:
    """The name of a part without the view's name, and the channels that belong to the view."""
    own = part.view or (part.name if part.name in names else "")
    bare = re.sub(rf"(^|[-._ ]){re.escape(view)}$|^{re.escape(view)}[-._ ]", "", part.name)
    if own:
        return bare, {channel: channel for channel in part.channels} if own == view else {}
    found: dict[str, str] = {}
    for channel in part.channels:
        words = channel.split(".")
        place = next((i for i in reversed(range(len(words) - 1)) if words[i] in names), None)
        if (words[place] if place is not None else names[0]) == view:
            name = ".".join(word for i, word in enumerate(words) if i != place)
            # If two channels get the same name, the one with the view in its name counts.
            found[name] = channel if place is not None else found.get(name, channel)
    return bare, found


def _infix(parts: Sequence[Part], view: str, names: Sequence[str]) -> str:
    own = any(view in (part.view, part.name) for part in parts)
    return "" if own or view == names[0] else view
