"""History by a network: bounded by this frame and the last at each scale, whatever the network says."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ngpt.errors import NgptError
from ngpt.sequence import network as blending
from ngpt.sequence.history import LONGEST, Temporal
from ngpt.sequence.network import BANDS, INPUTS, Network, shipped
from ngpt.stack import GradientStack

SIZE = (24, 36)


def frames(rng, count, size=SIZE, scale=1.0, **changes):
    """Noisy frames at rest, and the truth."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    image = scale * np.stack([1.5 + np.sin(x / 7 + c) * np.cos(y / 5) for c in range(3)], axis=-1)
    features = {"albedo": 0 * image + 0.5, "normal": 0 * image + [0, 0, 1], "depth": 4 + 0.01 * y[..., None]}
    made = []
    for _ in range(count):
        noisy = image + 0.2 * scale * rng.normal(size=image.shape)
        layers = features | {"primal": noisy, "primal_var": np.full(image.shape, (0.2 * scale) ** 2)}
        layers |= {"motion": np.zeros((*size, 2))} | changes
        made.append(GradientStack({name: np.float32(layer) for name, layer in layers.items()}))
    return made, image


def play(stacks, corrections):
    temporal = Temporal(corrections)
    return [temporal.next(stack, stack["primal"]) for stack in stacks], temporal


def constant(value):
    return lambda inputs: np.full((*inputs.shape[:2], BANDS), value, np.float32)


def test_without_a_word_of_the_network_results_are_those_of_the_rules(rng):
    stacks, _ = frames(rng, 6)
    rules, by_rules = play(stacks, None)
    silent, by_silence = play(stacks, constant(0.0))
    assert np.allclose(rules, silent, atol=0.01) and by_rules.share > 0.5
    assert np.allclose(by_rules.weight, by_silence.weight, atol=0.02)


def test_bands_add_up_to_the_change_and_results_lie_within_it(rng):
    """However much the network asks for, history counts for no more than the variances allow."""
    stacks, _ = frames(rng, 2)
    shares = []
    for value in (-50.0, 0.0, 50.0):
        results, temporal = play(stacks, constant(value))
        blend, weight = temporal.blend, temporal.weight[..., None]
        assert np.allclose(blend.bands.sum(axis=0), blend.history - blend.now, atol=1e-5)
        assert np.allclose(results[1], blend.now + weight * (blend.history - blend.now), atol=1e-3)
        assert (temporal.weight >= 0).all() and (temporal.weight <= blend.first + 1e-4).all()
        shares.append(temporal.share)
    assert shares[0] < 0.7 * shares[1] and shares[1] < shares[2]


def test_what_comes_into_sight_takes_nothing_from_what_hid_it(rng):
    """Though the network asks for it."""
    stacks, _ = frames(rng, 2)
    albedo = stacks[1]["albedo"].copy()
    albedo[6:14, 8:20] = 0.95
    motion = stacks[1]["motion"].copy()
    motion[:, -4:] = 100
    results, _ = play([stacks[0], stacks[1].replace(albedo=albedo, motion=motion)], constant(50.0))
    for place in (np.s_[7:13, 9:19], np.s_[:, -4:]):
        assert np.allclose(results[1][place], stacks[1]["primal"][place], atol=1e-3)
    assert np.abs(results[1] - stacks[1]["primal"]).mean() > 0.05


@pytest.fixture
def network():
    made = shipped()
    if made is None:
        pytest.skip("ONNX Runtime is not installed")
    return made


def test_the_shipped_network_averages_a_shot_at_rest(network, rng):
    stacks, truth = frames(rng, LONGEST)
    results, temporal = play(stacks, network)
    noise = np.mean(np.square(stacks[-1]["primal"] - truth))
    assert np.mean(np.square(results[-1] - truth)) < 0.25 * noise and temporal.share > 0.6


def test_the_shipped_network_lets_history_of_another_light_alone(network, rng):
    stacks, truth = frames(rng, 8)
    brighter, _ = frames(rng, 1, scale=2.0)
    results, _ = play([*stacks, *brighter], network)
    noise = np.mean(np.square(brighter[0]["primal"] - 2 * truth))
    assert np.mean(np.square(results[-1] - 2 * truth)) < 1.2 * noise


@pytest.mark.parametrize("k", [2.0**-10, 2.0**10])
def test_exposure_does_not_matter(network, rng, k):
    stacks, _ = frames(rng, 3)
    bright = [s.replace(primal=k * s["primal"], primal_var=k**2 * s["primal_var"]) for s in stacks]
    for one, other in zip(play(stacks, network)[0], play(bright, network)[0], strict=True):
        assert np.allclose(other, k * one, rtol=1e-3, atol=1e-4 * k)


def test_strips_agree_with_the_whole(network, rng, monkeypatch):
    inputs = rng.normal(size=(90, 21, len(INPUTS))).astype(np.float32)
    whole = network(inputs)
    monkeypatch.setattr(blending, "STRIP", 24 * 16)
    assert whole.shape == (90, 21, BANDS) and np.allclose(network(inputs), whole, atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 5)])
@pytest.mark.parametrize("scale", [0.0, 1e-8, 1e10])
def test_sizes_and_extremes(network, rng, size, scale):
    stacks, truth = frames(rng, 3, size, scale)
    results, _ = play(stacks, network)
    assert all(np.isfinite(result).all() and result.shape == truth.shape for result in results)


@pytest.mark.parametrize("without", [("primal_var",), ("albedo", "normal", "depth"), ("primal_var", "normal")])
def test_variances_and_features_are_not_needed(network, rng, without):
    stacks, truth = frames(rng, 6)
    stacks = [GradientStack({name: s[name] for name in s.names if name not in without}) for s in stacks]
    alone = [gaussian_filter(stack["primal"], (1, 1, 0)) for stack in stacks]
    temporal = Temporal(network)
    results = [temporal.next(*pair) for pair in zip(stacks, alone, strict=True)]
    assert np.mean(np.square(results[-1] - truth)) < 0.9 * np.mean(np.square(alone[-1] - truth))


def test_other_files_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    from ngpt.network.run import WEIGHTS

    with pytest.raises(NgptError, match="is no network that blends frames"):
        Network(WEIGHTS / "ngpt-fast.onnx")
    with pytest.raises(NgptError, match="no such file"):
        Network(tmp_path / "none.onnx")


def test_torch_is_not_imported():
    code = (
        "import sys; from ngpt.sequence.network import shipped; shipped(); "
        "print({'torch', 'mitsuba'} & sys.modules.keys())"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "set()"
