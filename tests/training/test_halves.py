"""Pairs: two halves of the samples judge each other, and what they agree on is the truth."""

import numpy as np
import pytest
import torch
from crops import PairedCrop, SyntheticCrop, settings

from ngpt.classical.gradients import forward_differences
from ngpt.errors import NgptError
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.training.augment import Augmentation
from ngpt.training.examples import Examples, collated, other_half
from ngpt.training.halves import halves
from ngpt.training.loss import make_loss


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def examples_of(*crops, augmentation=None, size=32, cache=0):
    return Examples(crops, settings().model, augmentation or Augmentation(), size, seed=0, cache=cache)


def render(generator, truth, share, n=8, size=256):
    """The mean of n samples that find the light with the probability ``share`` each, and its standard error."""
    found = torch.rand(n, 1, 3, size, size, generator=generator) < share
    samples = truth * (0.5 + 0.5 * found / share)
    return samples.mean(0), samples.std(0) / n**0.5


def the_least(other):
    """The constant that the loss is least for, by bisection of its slope: what weights see of it counts as given."""
    low, high = 0.2, 2.0
    for _ in range(9):
        k = torch.tensor((low + high) / 2, requires_grad=True)
        halves(4 * k + torch.zeros_like(other["primal"]), other).backward()
        low, high = (low, k.item()) if k.grad > 0 else (k.item(), high)
    return low


@pytest.mark.parametrize(
    ("share", "best", "worse"), [slow(0.5, 1, 1), slow(0.1, 1, 0.96), (0.03, 0.99, 0.69), slow(0.01, 0.88, 0.52)]
)
def test_the_least_is_at_the_truth_however_rare_light_is(share, best, worse):
    """Docs/train/losses.md has these numbers. Weights of the half that judges are small where it is bright."""
    generator = torch.Generator().manual_seed(1)
    (_, errors), (image, own) = (render(generator, 4.0, share) for _ in range(2))
    zero, one = torch.zeros_like(image), torch.ones_like(image[:, :1])
    other = {"primal": image, "dx": zero, "dy": zero, "dx_se": zero, "dy_se": zero, "counts": one}
    assert the_least(other | {"primal_se": errors}) == pytest.approx(best, abs=0.01)
    assert the_least(other | {"primal_se": own}) == pytest.approx(worse, abs=0.01)


def test_differences_and_not_only_means_are_judged():
    """An image that is right in all means, and not from pixel to pixel."""
    zero, one = torch.zeros(1, 3, 16, 16), torch.ones(1, 1, 16, 16)
    board = zero.clone()
    board[..., ::2, ::2] = board[..., 1::2, 1::2] = 1
    other = {"primal": board, "primal_se": 50 + zero, "dx_se": zero, "dy_se": zero, "counts": one}
    for name, axis in (("dx", -1), ("dy", -2)):
        other[name] = board.diff(dim=axis, append=board.narrow(axis, -1, 1))
    assert halves(board, other) == 0 and halves(zero, other) > 3


def test_what_does_not_count_changes_nothing():
    """A lamp that is seen in some pixels: neither its image nor the differences to it."""
    generator = torch.Generator().manual_seed(2)
    image, *layers = torch.randn(7, 2, 3, 8, 8, generator=generator)
    other = dict(zip(("primal", "dx", "dy", "primal_se", "dx_se", "dy_se"), layers, strict=True))
    other |= {name: layer.abs() for name, layer in other.items() if name.endswith("_se")}
    other["counts"] = torch.ones(2, 1, 8, 8)
    other["counts"][..., 3:5, 2:4] = 0
    changed = {name: layer.clone() for name, layer in other.items()}
    changed["primal"][..., 3:5, 2:4] = 1e6
    changed["dx"][..., 3:5, 1:4] = changed["dy"][..., 2:5, 2:4] = 1e6
    assert torch.equal(halves(image, other), halves(image, changed))
    assert halves(image, other | {"counts": torch.zeros(2, 1, 8, 8)}) == 0, "nothing counts, nothing is lost"


def test_both_halves_go_through_the_same():
    """Without noise, what judges is the input, and its differences are those of the image, however it is turned."""
    drawn = examples_of(PairedCrop("a", 3, 1e12), size=26)
    for example in (drawn[index] for index in range(12)):
        inside = np.s_[..., 15:-15, 15:-15]
        close = {"rtol": 1e-3, "atol": 1e-3}
        torch.testing.assert_close(example["primal"][inside], example["other/primal"], **close)
        for name, axis in (("dx", -1), ("dy", -2)):
            torch.testing.assert_close(example[name][inside], example[f"other/{name}"], **close)
            length = example["other/primal"].shape[axis] - 1
            difference = example[f"other/{name}"].narrow(axis, 0, length)
            torch.testing.assert_close(example["other/primal"].diff(dim=axis), difference, **close)
        assert example["other/counts"].min() == 1


@pytest.mark.parametrize("k", [0, 1])
def test_each_half_is_judged_by_the_other(k):
    crop = PairedCrop("a", 0)
    layers, judge = examples_of(crop, augmentation=Augmentation(False, False, 0))._layers(0, crop, k)
    images = [torch.from_numpy(crop.stack(i)["primal"]).permute(2, 0, 1) for i in (k, 1 - k)]
    assert torch.equal(layers["primal"], images[0]) and torch.equal(judge["primal"], images[1])


def test_a_share_of_the_examples_is_pairs():
    """One pair among nine crops with references, half of the examples; batches have targets first."""
    drawn = examples_of(*(SyntheticCrop(f"s{i}", i) for i in range(9)), PairedCrop("p", 9), cache=10**8)
    examples = [drawn[i] for i in range(60)]
    pairs = [example for example in examples if "target" not in example]
    assert 20 < len(pairs) < 40
    batch = collated(examples)
    assert len(batch["primal"]) == 60 and len(batch["target"]) == 60 - len(pairs)
    assert torch.equal(batch["primal"][60 - len(pairs)], pairs[0]["primal"])
    assert torch.equal(batch["other/primal"][-1], pairs[-1]["other/primal"])


def test_references_and_pairs_count_by_their_number():
    """Three crops with references and one pair: three quarters of one loss, a quarter of the other with its weight."""
    generator = torch.Generator().manual_seed(3)
    image, target, *layers = torch.rand(8, 4, 3, 8, 8, generator=generator)
    names = ("primal", "dx", "dy", "primal_se", "dx_se", "dy_se")
    other = {name: layer[3:] for name, layer in zip(names, layers, strict=True)} | {"counts": torch.ones(1, 1, 8, 8)}
    loss = make_loss({"kind": "l1", "gradient": 0.0, "halves": 0.5})
    total, parts = loss(image, target[:3], generator, other)
    assert parts["l1"] > 0.1 and parts["halves"] > 0.1
    assert total.item() == pytest.approx(0.75 * parts["l1"].item() + 0.25 * 0.5 * parts["halves"].item())


def test_what_cannot_be_learnt_from_is_refused():
    crop = PairedCrop("a", 0)
    crop.stack = lambda k: crop.of.stack(0)
    with pytest.raises(NgptError, match="both halves are the same"):
        examples_of(crop)[0]


def test_networks_without_gradients_are_judged_by_the_differences_of_the_whole_light():
    """Gradients hold none of the layer ``caustic``: its own differences are added to them, and their variances."""
    rng = np.random.default_rng(4)
    light = [rng.random((6, 5, 3), np.float32) for _ in range(2)]
    primal = [rng.random((6, 5, 3), np.float32) for _ in range(2)]
    variances = {f"{name}_var": np.full((6, 5, 3), v, np.float32) for name, v in (("dx", 1), ("dy", 4))}
    halves_of = [
        GradientStack.from_arrays(
            **{"primal": a + b, "caustic": b, "caustic_var": np.full_like(b, 9), "primal_var": np.full_like(b, 25)},
            **dict(zip(("dx", "dy"), forward_differences(a), strict=True)),
            **variances,
        )
        for a, b in zip(primal, light, strict=True)
    ]
    ours, other = repair(halves_of[0]), halves_of[1]
    judge, apart = (other_half(ours, other, whole) for whole in (True, False))
    assert np.allclose(judge["primal"], primal[1] + light[1]) and np.allclose(apart["primal"], primal[1], atol=1e-6)
    for name, axis, own in (("dx", 1, 1), ("dy", 0, 4)):
        inside = np.s_[:, :-1] if axis else np.s_[:-1]
        assert np.allclose(judge[name][inside], np.diff(primal[1] + light[1], axis=axis), atol=1e-5)
        assert np.allclose(apart[name][inside], np.diff(primal[1], axis=axis), atol=1e-5)
        assert np.allclose(judge[f"{name}_se"][inside] ** 2, own + 18) and np.allclose(apart[f"{name}_se"] ** 2, own)
    with pytest.raises(NgptError, match="both halves are the same"):
        other_half(ours, halves_of[0], True)
    assert np.allclose(judge["primal_se"] ** 2, 34) and np.allclose(apart["primal_se"] ** 2, 25)
