"""The network that blends frames: what it learns from, and that it does."""

import numpy as np
import pytest
from shots import frame_of

pytest.importorskip("torch")

import torch

from ngpt.sequence import train as training
from ngpt.sequence.network import BANDS, INPUTS, Network
from ngpt.sequence.train import Clip, as_corrections, errors, loss, network, play, scores, train

SIZE = 16


@pytest.fixture(autouse=True)
def quietly(one_thread):
    """All of them on one thread."""


def clip_of(seed, frames=5, flash=0.0):
    """A smooth image at rest with noise; ``flash``: as much light more in every second frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    image = np.stack([1.5 + np.sin(3 * x + c + seed) * np.cos(4 * y) for c in range(3)], axis=-1).astype(np.float32)
    stacks, references, halves = [], [], []
    for i in range(frames):
        truth = image * np.float32(1 + flash * (i % 2))
        beside = {"direct": 0 * truth, "albedo": np.full(truth.shape, 0.5), "depth": np.full((SIZE, SIZE, 1), 3.0)}
        stacks.append(frame_of(truth, beside, rng))
        pair = tuple(truth + np.float32(0.05 * rng.normal(size=truth.shape)) for _ in range(2))
        halves.append(pair)
        references.append((pair[0] + pair[1]) / 2)
    return Clip("synthetic", stacks, [stack["primal"] for stack in stacks], references, halves)


def test_errors_are_free_of_the_references_noise():
    clip = clip_of(0, frames=12)
    error, flicker = errors(clip, [stack["primal"] for stack in clip.stacks])
    squares = np.square(clip.references[0]).mean(axis=-1)
    expected = 0.04 * np.mean(1 / (squares + training.DARK * squares.mean()))
    assert error == pytest.approx(expected, rel=0.2) and flicker == pytest.approx(2 * expected, rel=0.2)


def test_a_network_that_says_nothing_has_the_loss_of_the_rules():
    clip = clip_of(1)
    model = network()
    frames = list(play(clip, as_corrections(model.eval())))
    assert len(frames) == 4 and all(frame["inputs"].shape == (len(INPUTS), SIZE, SIZE) for frame in frames)
    batch = {name: torch.from_numpy(np.stack([frame[name] for frame in frames])) for name in frames[0]}
    value = loss(model, batch).item()
    # Frame by frame it is 1 + FLICKER.
    assert 0.1 < value < 0.8 * (1 + training.FLICKER)


def test_it_learns_and_its_onnx_file_is_the_same(tmp_path):
    """Light flashes: the rules average some of it away, a network can learn better."""
    seen = [clip_of(seed, flash=0.15) for seed in range(4)]
    said = []
    model = train(seen, 2, 25, say=said.append)
    assert len(said) == 2 and "round 2 of 2" in said[1]
    held_out = [clip_of(9, flash=0.15)]
    ours, rules = (scores(held_out, which)[0] for which in (as_corrections(model), None))
    assert ours[0] < rules[0]
    pytest.importorskip("onnx")
    from ngpt.network.weights import write_tensors
    from ngpt.sequence.export import temporal_model

    header = {"kind": "temporal", "inputs": list(INPUTS), "widths": list(training.WIDTHS)}
    write_tensors(tmp_path / "t.safetensors", model.state_dict(), header)
    (tmp_path / "t.onnx").write_bytes(temporal_model(tmp_path / "t.safetensors").SerializeToString())
    inputs = np.random.default_rng(0).normal(size=(22, 19, len(INPUTS))).astype(np.float32)
    made = Network(tmp_path / "t.onnx")(inputs)
    assert made.shape == (22, 19, BANDS) and np.allclose(made, as_corrections(model)(inputs), atol=1e-4)


def test_results_are_kept_by_what_they_are_of(tmp_path, monkeypatch):
    """Not by numbers of shots, which change as a set grows."""
    from types import SimpleNamespace

    made = []

    def crop(scene, frame):
        pair = clip_of(0).halves[0]
        one = SimpleNamespace(scene=scene, inputs=1, index=frame, reference=pair[0], reference_direct=0 * pair[0])
        one.shard = SimpleNamespace(path=tmp_path / f"{scene}.safetensors")
        one.reference_caustic, one.reference_halves = 0 * pair[0], pair
        one.stack = lambda k: scene
        return one

    class Set(list):
        shots = property(lambda self: [range(i, i + 2) for i in range(0, len(self), 2)])

    def reconstruct(stack, method):
        made.append(stack)
        return SimpleNamespace(image=np.full((2, 2, 3), float(stack == "b"), np.float32))

    monkeypatch.setattr(training, "reconstruct", reconstruct)
    for scenes in ("b", "ab"):
        crops = Set(crop(scene, frame) for scene in scenes for frame in range(2))
        monkeypatch.setattr(training, "Dataset", lambda folder, crops=crops: crops)
        found = list(training.clips(["set"], ["primal"], tmp_path))
    assert made == ["b", "b", "a", "a"] and [clip.results[0].max() for clip in found] == [0, 1]
