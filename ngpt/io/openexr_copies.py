"""Lets pickle and copy handle OpenEXR's own kinds of header values: stacks that were read from files hold them."""

import copyreg
from typing import Any

import OpenEXR

_TIME = ("hours", "minutes", "seconds", "frame")
_TIME_CODE = (*_TIME, "dropFrame", "colorFrame", "fieldPhase", "bgf0", "bgf1", "bgf2", "userData")

# The arguments of the constructor, and the attributes that are set afterwards.
_FIELDS: dict[type, tuple[tuple[str, ...], tuple[str, ...]]] = {
    OpenEXR.Bytes: (("data", "type_hint"), ()),
    OpenEXR.Channel: (("name", "xSampling", "ySampling", "pLinear"), ()),  # as in headers, without pixels
    OpenEXR.KeyCode: (
        (),
        ("filmMfcCode", "filmType", "prefix", "count", "perfOffset", "perfsPerFrame", "perfsPerCount"),
    ),
    OpenEXR.OpaqueAttribute: (("data", "typeName"), ()),
    OpenEXR.PreviewImage: (("pixels",), ()),
    OpenEXR.TileDescription: ((), ("xSize", "ySize", "mode", "roundingMode")),
    OpenEXR.TimeCode: ((), _TIME_CODE),
}


def register() -> None:
    for kind in _FIELDS:
        copyreg.pickle(kind, _reduced)


def _reduced(value: Any) -> tuple:
    given, later = ({name: getattr(value, name) for name in names} for names in _FIELDS[type(value)])
    return _again, (type(value), tuple(given.values()), later)


def _again(kind: type, given: tuple, later: dict[str, Any]) -> Any:
    value = kind(*given)
    for name, field in later.items():
        setattr(value, name, field)
    return value
