"""Reconstruction over time: laws that hold for any method, by the rules and by the network that comes with ngpt."""

from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from shots import SIGMA, SIZE, frame_of, mse, part_of, view, without

from ngpt.measure.flicker import flicker
from ngpt.sequence.history import FAST, LONGEST, Temporal
from ngpt.stack import GradientStack


@pytest.fixture(params=[None, "shipped"], ids=["rules", "network"])
def history(request):
    """What begins a shot."""
    return partial(Temporal, request.param)


def smooth(stack):
    return gaussian_filter(stack["primal"], (1.5, 1.5, 0))


def identity(stack):
    return stack["primal"]


def played(temporal, stacks):
    """The results over time."""
    return [temporal.next(stack, smooth(stack)) for stack in stacks]


@pytest.mark.parametrize("method", [identity, smooth])
def test_a_shot_at_rest_converges(rng, history, method):
    image, features = view()
    temporal, stacks = history(), [frame_of(image, features, rng) for _ in range(LONGEST)]
    alone = [method(stack) for stack in stacks]
    over_time = [temporal.next(*pair) for pair in zip(stacks, alone, strict=True)]
    assert np.array_equal(over_time[0], alone[0])
    blur = mse(method(stacks[0].replace(primal=image)), image)
    noise = mse(alone[-1], image) - blur
    assert mse(over_time[-1], image) - blur < 0.25 * noise
    motions = [stack["motion"] for stack in stacks]
    truth = [image] * len(stacks)
    assert flicker(over_time[4:], truth[4:], motions[4:]) < 0.1 * flicker(alone[4:], truth[4:], motions[4:])


def test_a_shot_at_rest_is_the_mean_of_its_frames(rng):
    """Frame n + 1 has n / (n + 1) of its history: variances of the two parts of a blend add by squared weights."""
    image, features = view()
    temporal, weights = Temporal(None), []
    for _ in range(6):
        stack = frame_of(image, features, rng)
        temporal.next(stack, identity(stack))
        weights.append(np.median(temporal.weight))
    assert np.allclose(weights, [n / (n + 1) for n in range(6)], atol=0.02)


def test_a_camera_that_moves_by_one_pixel_finds_its_neighbour(rng, history):
    """As if at rest: the frame before, moved by a pixel, with the same noise."""
    image, features = view()
    one, other = frame_of(image, features, rng), frame_of(image, features, rng)
    moved = GradientStack({name: np.roll(layer, -1, axis=1) for name, layer in other.layers.items()})
    moved = moved.replace(motion=np.broadcast_to([1.0, 0.0], (*SIZE, 2)))
    path = history()
    path.next(one, smooth(one))
    at_rest, on_path = played(history(), [one, other])[1], path.next(moved, np.roll(smooth(other), -1, axis=1))
    # Windows see other things near the border, and some statistics are of the whole image.
    inside = np.s_[14:-14, 14:-15]
    wrong, blended = (np.abs(on_path - np.roll(image, -1, axis=1))[inside] for image in (at_rest, smooth(other)))
    assert wrong.mean() < 0.15 * blended.mean()
    assert path.weight[inside].mean() > 0.4


@pytest.mark.parametrize("name", ["albedo", "normal", "depth"])
def test_what_comes_into_sight_takes_nothing_from_what_hid_it(rng, history, name):
    image, features = view()
    before = frame_of(3 * image, features, rng)
    now = frame_of(image, features, rng)
    changed = now[name].copy()
    shown = np.s_[10:30, 5:25]
    changed[shown] = {"albedo": 0.1, "normal": [1, 0, 0], "depth": 9}[name]
    now = now.replace(**{name: changed})
    temporal = history()
    _, result = played(temporal, [before, now])
    within = np.s_[11:29, 6:24]
    assert np.allclose(temporal.weight[within], 0, atol=1e-4)
    assert np.allclose(result[within], smooth(now)[within], atol=1e-3)


@pytest.mark.parametrize("pixels", [0, 1, 3])
def test_history_counts_for_fewer_frames_of_a_fast_shot(pixels):
    """By motion in image widths: the light is the same everywhere and in all frames, so nothing else speaks against
    it."""
    flat, temporal = np.ones((20, 80, 3)), Temporal(None)
    moved = GradientStack({"primal": flat, "primal_var": 0.01 * flat, "motion": np.full((20, 80, 2), [pixels, 0.0])})
    temporal.next(moved, flat)
    temporal.assume(0)
    temporal.next(moved, flat)
    frames = LONGEST / (1 + pixels / 80 / FAST)
    assert np.allclose(temporal.weight[:, : 80 - pixels], frames / (1 + frames), atol=1e-5)


def test_history_of_another_light_is_left_alone(rng, history):
    image, features = view()
    temporal = history()
    played(temporal, [frame_of(image, features, rng) for _ in range(LONGEST)])
    stack = frame_of(2 * image, features, rng)
    (result,) = played(temporal, [stack])
    assert temporal.share < 0.05
    assert mse(result, 2 * image) < 1.2 * mse(smooth(stack), 2 * image)


def test_no_step_of_slow_changes_costs_more_than_it_gains(rng, history):
    """Light that grows by 2 % a frame: history lags behind, and the evidence sees to it that it does not by much."""
    image, features = view()
    temporal, alone, over_time = history(), [], []
    for i in range(24):
        stack = frame_of(image * 1.02**i, features, rng)
        truth = image * 1.02**i
        over_time.append(mse(temporal.next(stack, smooth(stack)), truth) / 1.02 ** (2 * i))
        alone.append(mse(smooth(stack), truth) / 1.02 ** (2 * i))
    assert np.mean(over_time[4:]) < 1.1 * np.mean(alone[4:])


def test_direct_emission_is_that_of_this_frame(rng, history):
    image, features = view()
    emission = np.zeros_like(image)
    emission[5:9, 5:9] = 50
    temporal = history()
    for i in range(3):
        stack = frame_of(image, features, rng)
        lamp = np.roll(emission, 2 * i, axis=1)
        stack = stack.replace(primal=stack["primal"] + lamp, direct=lamp)
        result = temporal.next(stack, smooth(stack.replace(primal=stack["primal"] - lamp)) + lamp)
    assert np.abs(result - lamp - image).max() < 1


@pytest.mark.parametrize("names", [("primal_var",), ("albedo", "normal", "depth"), ("primal_var", "depth")])
def test_variances_and_features_are_not_needed(rng, history, names):
    image, features = view()
    stacks = [without(frame_of(image, features, rng), *names) for _ in range(8)]
    assert mse(played(history(), stacks)[-1], image) < 0.9 * mse(smooth(stacks[-1]), image)


@pytest.mark.parametrize("grows", [0, 2])
def test_windows_that_move_find_their_history(rng, history, grows):
    """A shot at rest; each frame is a part of it that moves and changes its size."""
    image, features = view()
    stacks = [frame_of(image, features, rng) for _ in range(6)]
    windows = [(4 * i, i, 30 + grows * (i % 3), 30 - grows * (i % 2)) for i in range(len(stacks))]
    parts = [part_of(stack, *window) for stack, window in zip(stacks, windows, strict=True)]
    temporal, whole = history(), played(history(), stacks)
    for i, part in enumerate(parts):
        alone, found = smooth(part), temporal.next(part, smooth(part))
        known, truth = part.place.data.within(part.place.display), image[part.place.data.within(part.place.display)]
        assert i == 0 or mse(found, truth) < 0.95 * mse(alone, truth)  # blur is in both
        assert np.abs(found - whole[i][known])[5:-5, 5:-9].mean() < 0.1 * SIGMA


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda frame: frame, ""),
        (lambda frame: without(frame, "motion"), "no layer 'motion'"),
        (lambda frame: frame.replace(motion=np.full((*SIZE, 2), 99.0)), "motion is not known, or leads out of"),
        (lambda frame: frame.replace(motion=np.full((*SIZE, 2), np.nan)), "motion is not known, or leads out of"),
        (lambda frame: frame.replace(albedo=1 - frame["albedo"], depth=9 + 0 * frame["depth"]), "albedo, normal or"),
        (lambda frame: frame.replace(primal=9 * frame["primal"]), "the light differs"),
        (lambda frame: GradientStack({k: v[:-4] for k, v in frame.layers.items()}), "is "),
        (lambda frame: GradientStack(frame.layers, {"ngpt:previousFrame": 4}), "is made after frame 4, and the frame"),
    ],
)
def test_history_that_counts_for_nothing_has_a_reason(rng, history, change, reason):
    image, features = view()
    first, second = (frame_of(image, features, rng, **{"ngpt:frame": i}) for i in (6, 7))
    temporal, last = history(), change(second)
    played(temporal, [first])
    assert temporal.reason == "the first frame" and temporal.share == 0
    (result,) = played(temporal, [last])
    assert temporal.reason.startswith(reason) and bool(temporal.reason) == (temporal.share < 0.005) == bool(reason)
    if temporal.share == 0:
        assert np.array_equal(result, smooth(last))
        # A cut is a beginning, too.
        following = {"ngpt:frame": 8, "ngpt:previousFrame": last.attributes.get("ngpt:frame", 7)}
        size = last["primal"].shape
        played(temporal, [frame_of(image[: size[0]], {k: v[: size[0]] for k, v in features.items()}, rng, **following)])
        assert temporal.share > 0.3
