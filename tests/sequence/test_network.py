"""History by a network: bounded by this frame and the last at each scale, whatever the network says."""

import numpy as np
import pytest
from shots import frame_of, view

from ngpt.errors import NgptError
from ngpt.sequence import network as module
from ngpt.sequence.history import Temporal
from ngpt.sequence.network import BANDS, INPUTS, CorrectionNetwork, shipped

SIZE = (24, 36)


@pytest.fixture
def stacks(rng):
    """Frames at rest, with noise."""
    return [frame_of(*view(*SIZE), rng) for _ in range(6)]


def play(stacks, corrections):
    temporal = Temporal(corrections)
    return [temporal.next(stack, stack["primal"]) for stack in stacks], temporal


def constant(value):
    return lambda inputs: np.full((*inputs.shape[:2], BANDS), value, np.float32)


def test_without_a_word_of_the_network_results_are_those_of_the_rules(stacks):
    rules, by_rules = play(stacks, None)
    silent, by_silence = play(stacks, constant(0.0))
    assert np.allclose(rules, silent, atol=0.01) and by_rules.share > 0.5
    assert np.allclose(by_rules.weight, by_silence.weight, atol=0.02)


def test_bands_add_up_to_the_change_and_results_lie_within_it(stacks):
    """However much the network asks for, history counts for no more than the variances allow."""
    shares = []
    for value in (-50.0, 0.0, 50.0):
        results, temporal = play(stacks[:2], constant(value))
        blend, weight = temporal.blend, temporal.weight[..., None]
        assert np.allclose(blend.bands.sum(axis=0), blend.history - blend.now, atol=1e-5)
        assert np.allclose(results[1], blend.now + weight * (blend.history - blend.now), atol=1e-3)
        assert (temporal.weight >= 0).all() and (temporal.weight <= blend.first + 1e-4).all()
        shares.append(temporal.share)
    assert shares[0] < 0.7 * shares[1] and shares[1] < shares[2]


def test_what_comes_into_sight_takes_nothing_from_what_hid_it(stacks):
    """Though the network asks for it."""
    albedo, motion = stacks[1]["albedo"].copy(), stacks[1]["motion"].copy()
    albedo[6:14, 8:20], motion[:, -4:] = 0.95, 100
    results, _ = play([stacks[0], stacks[1].replace(albedo=albedo, motion=motion)], constant(50.0))
    for place in (np.s_[7:13, 9:19], np.s_[:, -4:]):
        assert np.allclose(results[1][place], stacks[1]["primal"][place], atol=1e-3)
    assert np.abs(results[1] - stacks[1]["primal"]).mean() > 0.05


def test_strips_agree_with_the_whole(rng, monkeypatch):
    network = shipped()
    if network is None:
        pytest.skip("ONNX Runtime is not installed")
    inputs = rng.normal(size=(90, 21, len(INPUTS))).astype(np.float32)
    whole = network(inputs)
    monkeypatch.setattr(module, "STRIP", 24 * 16)
    assert whole.shape == (90, 21, BANDS) and np.allclose(network(inputs), whole, atol=1e-5)


@pytest.mark.parametrize("file", ["ngpt-fast.onnx", "none.onnx", "torn.onnx"])
def test_other_files_are_refused(tmp_path, file):
    onnx = pytest.importorskip("onnx")
    from ngpt.network.shipped import WEIGHTS

    torn = onnx.load(module.WEIGHTS)
    next(entry for entry in torn.metadata_props if entry.key == "ngpt.alignment").value = "much"
    onnx.save(torn, tmp_path / "torn.onnx")
    messages = {"ngpt-fast.onnx": "is no network that blends frames", "none.onnx": "no such file"}
    with pytest.raises(NgptError, match=messages.get(file, "torn.onnx: its metadata .* no whole number")):
        CorrectionNetwork((WEIGHTS if file.startswith("ngpt") else tmp_path) / file)
