"""Lets pickle and copy handle OpenEXR's own types of header values, which stacks from files hold."""

import copyreg
from typing import Any

import OpenEXR

# Types -> the attributes that their constructors take; all other attributes can be set afterwards.
_CONSTRUCTED: dict[type, tuple[str, ...]] = {
    OpenEXR.Bytes: ("data", "type_hint"),
    OpenEXR.Channel: ("name", "xSampling", "ySampling", "pLinear"),  # as in headers, without pixels
    OpenEXR.KeyCode: (),
    OpenEXR.OpaqueAttribute: ("data", "typeName"),
    OpenEXR.PreviewImage: ("pixels",),
    OpenEXR.TileDescription: (),
    OpenEXR.TimeCode: (),
}


def register() -> None:
    for kind in _CONSTRUCTED:
        copyreg.pickle(kind, _reduced)


def _reduced(value: Any) -> tuple:
    given = _CONSTRUCTED[type(value)]
    later = [] if given else [name for name, entry in vars(type(value)).items() if getattr(entry, "fset", None)]
    return _again, (type(value), [getattr(value, name) for name in given], {n: getattr(value, n) for n in later})


def _again(kind: type, given: list, later: dict[str, Any]) -> Any:
    value = kind(*given)
    for name, field in later.items():
        setattr(value, name, field)
    return value
