"""What is set aside for validation, and that it is said."""

import pytest

from ngpt.errors import NgptError
from ngpt.training.split import split


class Named:
    """All that a split asks of a crop."""

    def __init__(self, scene: str, paired: bool = False):
        self.scene, self.paired = scene, paired


def crops(*scenes: str, of_each: int = 2, paired: bool = False) -> list[Named]:
    return [Named(scene, paired) for scene in scenes for _ in range(of_each)]


def made(count: int) -> list[str]:
    return [f"made-{i:05d}" for i in range(count)]


def test_named_scenes_are_set_aside_whole():
    given = crops("room1", "room2", "hall")
    training, held_out, told = split(given, ("room1", "ha"), 0.5)
    assert held_out == given[:2] + given[4:] and training == given[2:4]
    assert told == "validation: 2 of 3 scenes set aside, 4 crops: hall, room1"
    with pytest.raises(NgptError, match="no scene has a name that begins with 'nosuch'; there are hall, room1, room2"):
        split(given, ("room", "nosuch"))


@pytest.mark.parametrize("scenes", [2, 3, 20, 57])
@pytest.mark.parametrize("share", [0.01, 0.1, 0.5, 0.99])
def test_a_share_of_the_scenes_is_set_aside_whole(scenes, share):
    given = crops(*made(scenes))
    training, held_out, told = split(given, (), share)
    apart = {crop.scene for crop in held_out}
    assert len(apart) == min(max(1, round(share * scenes)), scenes - 1)
    assert not apart & {crop.scene for crop in training} and len(training) + len(held_out) == len(given)
    assert told.startswith(f"validation: {len(apart)} of {scenes} scenes set aside, {2 * len(apart)} crops: ")
    # The order of crops and of folders changes nothing.
    assert {crop.scene for crop in split(given[::-1], (), share).held_out} == apart


def test_nothing_is_set_aside_where_nothing_can_measure_or_nobody_asks():
    given = crops("a", "b", paired=True)
    assert split(given, (), 0.1)[:2] == (given, []) and "pairs have no reference" in split(given, (), 0.1).line
    measured = crops("a", "b")
    assert split(measured, (), 0.0)[:2] == (measured, []) and "validation_share = 0" in split(measured).line
    # All crops are rendered while the network trains.
    assert split([], ("scene1",), 0.1) == ([], [], "")


def test_pairs_are_trained_on_and_those_of_scenes_set_aside_are_not():
    given = [*crops("a", "b"), *crops("a", "b", "c", paired=True)]
    training, held_out, _ = split(given, (), 0.1)
    (apart,) = {crop.scene for crop in held_out}
    assert len(held_out) == 2 and {crop.scene for crop in training} == {"a", "b", "c"} - {apart}
    # The one scene with references is split, and all pairs are kept.
    training, held_out, _ = split([*crops("a"), *crops("a", "b", paired=True)], (), 0.1)
    assert len(held_out) == 1 and len(training) == 5
