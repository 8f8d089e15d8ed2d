"""The variants of the paper's network, and how they are judged."""

import numpy as np
import pytest

pytest.importorskip("flip_evaluator")

from crops import SyntheticCrop

from bench.ablations import VARIANTS, judged, mean, table
from ngpt.network.model import ModelConfig, Reconstructor
from ngpt.system import configs
from ngpt.training.settings import read_settings


def settings(name):
    return read_settings(configs.find_config("ablations", configs.TRAINING), VARIANTS[name])


def test_variants_differ_in_what_they_are_named_for():
    usual = settings("dense")
    assert usual.model.network == "dense"
    assert not Reconstructor(settings("no gradients").model).config.reads_gradients
    assert settings("bilinear").model.pooling == "bilinear"
    assert settings("l1 alone").loss["kind"] == "l1"
    assert len({str(settings(name)) for name in VARIANTS}) == len(VARIANTS)
    # All that is not the point of a variant is as in the others.
    for name in VARIANTS:
        changed = settings(name)
        assert (changed.run, changed.optimizer, changed.augmentation) == (
            usual.run,
            usual.optimizer,
            usual.augmentation,
        )


def test_inputs_are_judged_apart_by_their_samples():
    class Perfect(Reconstructor):
        """Gives back what it reads, which is how the primal is scored."""

        def forward(self, layers):
            return layers["primal"]

    model = Perfect(ModelConfig("dense", (4,), (1,), ("primal",)))
    rows = judged(model, [SyntheticCrop("a", 0, 48), SyntheticCrop("b", 1, 48)])
    assert [row["spp"] for row in rows] == [4, 32, 4, 32]
    for row in rows:
        assert row["relMSE trimmed"] == pytest.approx(row["relMSE trimmed primal"])
        assert row["FLIP"] == pytest.approx(row["FLIP primal"])
    few, many = (mean(rows, "relMSE trimmed", which) for which in (True, False))
    assert few == pytest.approx(np.sqrt(rows[0]["relMSE trimmed"] * rows[2]["relMSE trimmed"]))
    assert 4 < few / many < 16
    text = table({"variants": {"dense": {"parameters": 1234, "multiplications": 5678.0, "inputs": rows}}})
    assert text.splitlines()[2].startswith(f"| dense | 1 k | 6 k | {few:.4f} | {many:.4f} |")
