"""Pairs: two halves of the samples judge each other, and what they agree on is the truth."""

import json

import numpy as np
import pytest
import torch
from crops import SyntheticCrop

from ngpt.errors import NgptError
from ngpt.training.augment import Augmentation
from ngpt.training.examples import Examples, collated
from ngpt.training.halves import halves
from ngpt.training.loss import make_loss
from ngpt.training.settings import from_dict
from ngpt.training.trainer import Trainer


class PairedCrop:
    """Two renders of one view, of equally many samples, and nothing else."""

    inputs, paired = 2, True

    def __init__(self, scene: str, seed: int, spp: float = 16):
        self.scene, self.spp, self.of = scene, (spp, spp), SyntheticCrop(scene, seed)
        self.of.spp = self.spp

    def stack(self, k):
        return self.of.stack(k)


MODEL = {
    "network": "dense",
    "channels": [4, 6],
    "units": [1, 1],
    "inputs": ["primal", "dx", "dy", "albedo", "normal", "depth"],
}
SETTINGS = {
    "model": MODEL,
    "data": {"crop": 32, "pairs": 0.5},
    "loss": {"kind": "l1", "halves": 0.5},
    "optimizer": {"learning_rate": 1e-2, "schedule": "cosine", "warmup": 5},
    "run": {"steps": 6, "batch": 4, "log": 1, "save": 3, "validate": 6},
}


def settings(**run):
    values = json.loads(json.dumps(SETTINGS))
    values["run"] |= run
    return from_dict(values, "test")


def render(generator, truth, share, n=8, size=256):
    """The mean of n samples that find the light with the probability ``share`` each, and its standard error."""
    found = torch.rand(n, 1, 3, size, size, generator=generator) < share
    samples = truth * (0.5 + 0.5 * found / share)
    return samples.mean(0), samples.std(0) / n**0.5


def the_least(other):
    """The constant that the loss is least for, by bisection of its slope: what weights see of it counts as given."""
    low, high = 0.2, 2.0
    for _ in range(12):
        k = torch.tensor((low + high) / 2, requires_grad=True)
        halves(4 * k + torch.zeros_like(other["primal"]), other).backward()
        low, high = (low, k.item()) if k.grad > 0 else (k.item(), high)
    return low


@pytest.mark.parametrize(
    ("share", "best", "worse"), [(0.5, 1, 1), (0.1, 1, 0.96), (0.03, 0.99, 0.69), (0.01, 0.88, 0.52)]
)
def test_the_least_is_at_the_truth_however_rare_light_is(share, best, worse):
    """Docs/train/losses.md has these numbers. Weights of the half that judges are small where it is bright."""
    generator = torch.Generator().manual_seed(1)
    (_, errors), (image, own) = (render(generator, 4.0, share) for _ in range(2))
    zero, one = torch.zeros_like(image), torch.ones_like(image[:, :1])
    other = {"primal": image, "dx": zero, "dy": zero, "dx_se": zero, "dy_se": zero, "counts": one}
    assert the_least(other | {"primal_se": errors}) == pytest.approx(best, abs=0.01)
    assert the_least(other | {"primal_se": own}) == pytest.approx(worse, abs=0.01)


def some_other(generator, size=8, **options):
    def draw(*channels):
        return torch.randn(2, *channels, size, size, generator=generator, **options)

    other = {name: draw(3) for name in ("primal", "dx", "dy")}
    other |= {f"{name}_se": draw(3).abs() for name in ("primal", "dx", "dy")}
    return other | {"counts": (draw(1) > -1).to(other["dx"].dtype)}


def test_differences_and_not_only_means_are_judged():
    """An image that is right in all means, and not from pixel to pixel."""
    zero, one = torch.zeros(1, 3, 16, 16), torch.ones(1, 1, 16, 16)
    other = dict.fromkeys(("primal", "dx", "dy", "dx_se", "dy_se"), zero) | {"primal_se": 50 + zero, "counts": one}
    board = zero.clone()
    board[..., ::2, ::2] = board[..., 1::2, 1::2] = 1
    assert halves(zero, other) == 0 and halves(board, other) > 3


def test_what_does_not_count_changes_nothing():
    """A lamp that is seen in some pixels: neither its image nor the differences to it."""
    generator = torch.Generator().manual_seed(2)
    other, image = some_other(generator), torch.randn(2, 3, 8, 8, generator=generator)
    other["counts"] = torch.ones(2, 1, 8, 8)
    other["counts"][..., 3:5, 2:4] = 0
    changed = {name: layer.clone() for name, layer in other.items()}
    changed["primal"][..., 3:5, 2:4] = 1e6
    changed["dx"][..., 3:5, 1:4] = changed["dy"][..., 2:5, 2:4] = 1e6
    assert torch.equal(halves(image, other), halves(image, changed))
    dark = other | {"counts": torch.zeros(2, 1, 8, 8)}
    assert halves(image, dark) == 0, "nothing counts, nothing is lost"


def test_both_halves_go_through_the_same(rng):
    """Without noise, what judges is the input, and its differences are those of the image, however it is turned."""
    drawn = Examples([PairedCrop("a", 3, 1e12)], settings().model, Augmentation(), 26, seed=0)
    for index in range(12):
        example = drawn[index]
        inside = np.s_[..., 15:-15, 15:-15]
        close = {"rtol": 1e-3, "atol": 1e-3}
        torch.testing.assert_close(example["primal"][inside], example["other/primal"], **close)
        for name, axis in (("dx", -1), ("dy", -2)):
            torch.testing.assert_close(example[name][inside], example[f"other/{name}"], **close)
            length = example["other/primal"].shape[axis] - 1
            difference = example[f"other/{name}"].narrow(axis, 0, length)
            torch.testing.assert_close(example["other/primal"].diff(dim=axis), difference, **close)
        assert example["other/counts"].min() == 1


def test_each_half_is_judged_by_the_other():
    crop = PairedCrop("a", 0)
    drawn = Examples([crop], settings().model, Augmentation(False, False, 0), 32, seed=0)
    for k in range(2):
        layers, judge = drawn._layers(0, crop, k)
        images = [torch.from_numpy(crop.stack(i)["primal"]).permute(2, 0, 1) for i in (k, 1 - k)]
        assert torch.equal(layers["primal"], images[0]) and torch.equal(judge["primal"], images[1])


def test_a_share_of_the_examples_is_pairs():
    """One pair among nine crops with references, half of the examples; batches have targets first."""
    crops = [SyntheticCrop(f"s{i}", i) for i in range(9)] + [PairedCrop("p", 9)]
    drawn = Examples(crops, settings().model, Augmentation(), 32, seed=0, cache=10**8)
    examples = [drawn[i] for i in range(60)]
    pairs = [example for example in examples if "target" not in example]
    assert 20 < len(pairs) < 40
    batch = collated(examples)
    assert len(batch["primal"]) == 60 and len(batch["target"]) == 60 - len(pairs)
    assert torch.equal(batch["primal"][60 - len(pairs)], pairs[0]["primal"])
    assert torch.equal(batch["other/primal"][-1], pairs[-1]["other/primal"])


def test_what_cannot_be_learnt_from_is_refused():
    crop = PairedCrop("a", 0)
    crop.stack = lambda k: crop.of.stack(0)
    drawn = Examples([crop], settings().model, Augmentation(), 32, seed=0)
    with pytest.raises(NgptError, match="both halves are the same"):
        drawn[0]
    bare = from_dict({"model": MODEL | {"inputs": ["primal", "albedo"]}}, "test").model
    with pytest.raises(NgptError, match="the network reads none"):
        Examples([PairedCrop("a", 0)], bare, Augmentation(), 32, seed=0)
    with pytest.raises(NgptError, match=r"data.pairs = 1.0: must be a share"):
        from_dict(SETTINGS | {"data": {"pairs": 1.0}}, "test")


def test_a_run_of_both_kinds_goes_on_bit_for_bit(tmp_path):
    def trainer(name):
        (tmp_path / name).mkdir(exist_ok=True)
        crops, chosen = [SyntheticCrop("a", 0), PairedCrop("b", 1)], settings()
        return Trainer(chosen, crops, [], make_loss(chosen.loss), tmp_path / name, say=lambda _: None)

    whole, first = trainer("whole"), trainer("part")
    whole.run()
    first.run(progress=lambda done, total: first._interrupt() if done == 2 else None)
    rest = trainer("part")
    rest.resume()
    assert first.step == rest.step < 4
    rest.run()
    for a, b in zip(whole.model.parameters(), rest.model.parameters(), strict=True):
        assert torch.equal(a, b)
