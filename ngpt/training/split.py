"""Splits crops into crops for training and crops for validation, by whole scenes."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from ngpt.errors import NgptError

# A message lists at most this number of names.
_LISTED = 8


class Split(NamedTuple):
    """Crops for ``training``, crops ``held_out`` for validation, and a line of text about the split."""

    training: list[Any]
    held_out: list[Any]
    line: str


def split(crops: Sequence[Any], validation: tuple[str, ...] = (), share: float = 0.0) -> Split:
    """Sets aside, for validation, the scenes whose names begin with one of ``validation``.

    If ``validation`` is empty, a ``share`` of the scenes is set aside, at least one. They are chosen by hashes of their
    names, so that the same set is always split in the same way. With a single scene, a share of its crops is set aside;
    a single crop goes to training.

    No error can be measured on pairs (crops without a reference), so pairs of scenes that are set aside are in neither
    part. Raises NgptError for a name in ``validation`` that no scene begins with.
    """
    scenes = sorted({crop.scene for crop in crops})
    if not scenes:
        return Split([], [], "")
    for name in validation:
        if not any(scene.startswith(name) for scene in scenes):
            raise NgptError(
                f"data.validation: no scene has a name that begins with '{name}'; there are {_listed(scenes)}. "
                "--set data.validation='[]' sets a share of the scenes aside"
            )
    if not validation and not share:
        return Split(list(crops), [], "validation: nothing is set aside (data.validation_share = 0)")
    measurable = [crop for crop in crops if not crop.paired]
    known = sorted({crop.scene for crop in measurable})
    if not validation and len(known) == 1:
        return _of_one_scene(list(crops), measurable, share)
    if not known and not validation:
        return Split(list(crops), [], "validation: nothing is set aside, since pairs have no reference")
    apart = {scene for scene in scenes if scene.startswith(validation)} if validation else _chosen(known, share)
    training = [crop for crop in crops if crop.scene not in apart]
    held_out = [crop for crop in measurable if crop.scene in apart]
    line = (
        f"validation: {len(apart)} of {len(scenes)} scenes set aside, {len(held_out)} crops: {_listed(sorted(apart))}"
    )
    return Split(training, held_out, line)


def _of_one_scene(crops: list[Any], measurable: list[Any], share: float) -> Split:
    """Splits the crops of a single scene. Errors on its validation crops are lower than on another scene."""
    scene, number = measurable[0].scene, len(measurable)
    count = min(_count(number, share), number - 1)
    if not count:
        return Split(crops, [], f"validation: nothing is set aside, since only one crop has a reference ('{scene}')")
    held_out = [measurable[i * number // count] for i in range(count)]
    line = f"validation: {count} of {number} crops set aside, of '{scene}' as are the others: there is no second scene"
    return Split([crop for crop in crops if crop not in held_out], held_out, line)


def _chosen(scenes: list[str], share: float) -> set[str]:
    """A share of the scenes, in the order of hashes, so that most of them stay chosen when a set grows."""
    ordered = sorted(scenes, key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    return set(ordered[: min(_count(len(scenes), share), len(scenes) - 1)])


def _count(number: int, share: float) -> int:
    return max(1, round(share * number))


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
