"""The network that blends frames: what it learns from, and that it does, as a task of the trainer."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_sets import crop_data, write_set
from shots import frame_of, without

from ngpt.cli import main
from ngpt.errors import NgptError
from ngpt.network import safetensors
from ngpt.sequence.network import BANDS, INPUTS, CorrectionNetwork
from ngpt.training import clips as module
from ngpt.training.clips import Clip, errors
from ngpt.training.settings import from_dict
from ngpt.training.temporal import Blending, as_corrections, load
from ngpt.training.trainer import Trainer

SIZE = 16


def clip_of(seed, frames=5, flash=0.0, size=SIZE):
    """A smooth image at rest with noise; ``flash``: as much light more in every second frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    image = np.stack([1.5 + np.sin(3 * x + c + seed) * np.cos(4 * y) for c in range(3)], axis=-1).astype(np.float32)
    stacks, references, halves = [], [], []
    for i in range(frames):
        truth = image * np.float32(1 + flash * (i % 2))
        beside = {"direct": 0 * truth, "albedo": np.full(truth.shape, 0.5), "depth": np.full((size, size, 1), 3.0)}
        stacks.append(frame_of(truth, beside, rng))
        pair = tuple(truth + np.float32(0.05 * rng.normal(size=truth.shape)) for _ in range(2))
        halves.append(pair)
        references.append((pair[0] + pair[1]) / 2)
    return Clip("synthetic", stacks, [stack["primal"] for stack in stacks], references, halves)


def test_errors_are_free_of_the_references_noise():
    clip = clip_of(0, frames=12)
    error, flicker = errors(clip, [stack["primal"] for stack in clip.stacks])
    squares = np.square(clip.references[0]).mean(axis=-1)
    expected = 0.04 * np.mean(1 / (squares + module.DARK * squares.mean()))
    assert error == pytest.approx(expected, rel=0.2) and flicker == pytest.approx(2 * expected, rel=0.2)
    # An image without noise has no flicker, whatever the noise of the references.
    still = [np.mean(clip.references, axis=0)] * 12
    assert abs(errors(clip, still)[1]) < 0.02 * expected


SETTINGS = {
    "temporal": {"methods": ["wcv"], "round": 25, "clips": 60},
    "optimizer": {"learning_rate": 2e-3, "schedule": "cosine", "warmup": 0, "clip": 1.0},
    "run": {"steps": 50, "batch": 8, "log": 5, "save": 30, "validate": 50},
}


def trainer(out, seen=None, initial="", **changes):
    out.mkdir(exist_ok=True)
    values = {name: SETTINGS[name] | changes.get(name, {}) for name in SETTINGS}
    settings = from_dict(values | {"initial": initial}, "test")
    task = Blending(settings, seen or [clip_of(seed, flash=0.15) for seed in range(4)], [clip_of(9, flash=0.15)])
    return Trainer(settings, task, out, say=lambda text: None)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run of two rounds."""
    out = tmp_path_factory.mktemp("blending") / "run"
    assert trainer(out).run()
    return out


def log_of(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def test_it_learns_and_its_onnx_file_is_the_same(finished, tmp_path):
    """Light flashes: the rules average some of it away, a network can learn better."""
    scores = log_of(finished)[-1]
    assert scores["relMSE"] < scores["relMSE base"] and scores["flicker"] < scores["flicker primal"]
    assert {"run.html", "validation-0000050.png", "best.safetensors"} <= {path.name for path in finished.iterdir()}
    assert "flicker of the shots held out" in (finished / "run.html").read_text()
    pytest.importorskip("onnx")
    # Its weights in 16 bits, and what computes with them in 32
    halves, graph = tmp_path / "half.safetensors", tmp_path / "t.onnx"
    for weights, output in ((finished / "weights.safetensors", halves), (halves, graph)):
        assert main(["export", "--weights", str(weights), "-o", str(output)]) == 0
    inputs = np.random.default_rng(0).normal(size=(22, 19, len(INPUTS))).astype(np.float32)
    made, (model, header) = CorrectionNetwork(graph)(inputs), load(halves)
    assert made.shape == (22, 19, BANDS) and np.allclose(made, as_corrections(model)(inputs), atol=1e-4)
    assert header["training"]["step"] == 50


def test_a_stopped_run_continues_bit_for_bit_amid_a_round(tmp_path):
    """Early in training, when each step changes the histories that the network makes."""
    chosen = {"temporal": {"round": 4}, "run": {"steps": 8, "log": 1}}
    whole, part = (trainer(tmp_path / name, **chosen) for name in ("whole", "part"))
    whole.run()
    assert not part.run(progress=lambda done, total: part._interrupt() if done == 6 else None)
    rest = trainer(tmp_path / "part", **chosen)
    rest.resume()
    assert rest.step == 6
    rest.run()
    one, other = (safetensors.read_tensors(run.checkpoint)[0] for run in (whole, rest))
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    losses = [[entry.get("loss") for entry in log_of(run.out)] for run in (whole, rest)]
    assert losses[0] == losses[1]


def test_it_starts_from_weights_and_those_of_other_kinds_are_refused(finished, tmp_path):
    path = str(finished / "weights.safetensors")
    started = trainer(tmp_path, initial=path).model.state_dict()
    assert all(torch.equal(started[name], tensor) for name, tensor in safetensors.read_tensors(path)[0].items())
    assert trainer(tmp_path, initial="temporal").model.state_dict().keys() == started.keys()
    with pytest.raises(NgptError, match="ngpt-fast: holds no network that blends frames"):
        trainer(tmp_path, initial="ngpt-fast")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"model": {"network": "plain", "channels": [4], "units": [], "inputs": ["primal"]}}, "and not both"),
        ({"temporal": {"methods": ["wvc"]}}, "temporal.methods: unknown method 'wvc'; did you mean 'wcv'"),
        ({"temporal": {"methods": []}}, "give one at least"),
        ({"temporal": {"round": 0}}, "temporal.round = 0: must be at least 1"),
        ({"loss": {"kind": "l1"}}, "are for networks that make images"),
        ({"data": {"folders": ["data-shots.toml"]}}, "shots cannot be rendered during training"),
    ],
)
def test_settings_are_checked(change, complaint):
    with pytest.raises(NgptError, match=complaint):
        from_dict(SETTINGS | change, "test")


def test_shots_without_motion_teach_nothing(tmp_path):
    clip = clip_of(0)
    still = [without(stack, "motion") for stack in clip.stacks]
    with pytest.raises(NgptError, match="no frame of these shots has a history"):
        trainer(tmp_path, [Clip("still", still, clip.results, clip.references, clip.halves)]).run()


@pytest.mark.parametrize(("sizes", "found"), [((8, 12), "8x8, 12x12"), ((10,), "10x10")])
def test_shots_that_make_no_batch_are_refused(tmp_path, sizes, found):
    with pytest.raises(NgptError, match=f"have {found} pixels; a batch needs squares of one size, a multiple of 4"):
        trainer(tmp_path, [clip_of(0, frames=2, size=size) for size in sizes])


def shot(rng, frames):
    return [crop_data(rng, halves=True, motion=np.zeros((8, 8, 2), np.float32)) for _ in range(frames)]


def test_results_are_kept_by_what_they_are_of(tmp_path, rng, monkeypatch):
    """Not by numbers or names of shots: sets grow, and sets share names."""
    made, results = [], tmp_path / "results"

    def reconstruct(stack, method):
        made.append(stack)
        return SimpleNamespace(image=np.full((2, 2, 3), len(made), np.float32))

    monkeypatch.setattr(module, "reconstruct", reconstruct)
    one, two, three = (shot(rng, 2) for _ in range(3))
    sets = [{"b": one}, {"a": two, "b": one}, {"b": three}]
    for number, (shots, first) in enumerate(zip(sets, ([1, 3], [5, 7, 1, 3], [9, 11]), strict=True)):
        write_set(tmp_path / str(number), shots, [0, 1] * len(shots))
        found = module.clips([tmp_path / str(number)], ["primal"], results)
        assert [clip.results[0].max() for clip in found] == first
    for path in results.iterdir():
        path.write_bytes(b"damaged")
    assert [clip.results[0].max() for clip in module.clips([tmp_path / "0"], ["primal"], results)] == [13, 15]


@pytest.mark.parametrize("frames", [(), (0, 0)], ids=["images", "frames that no other follows"])
def test_sets_without_shots_are_refused(tmp_path, rng, frames):
    write_set(tmp_path / "still", {"a": shot(rng, 2)}, frames)
    with pytest.raises(NgptError, match="still: no shots to learn from; make them with: ngpt dataset"):
        list(module.clips([tmp_path / "still"], ["primal"], tmp_path / "results"))


def test_one_command_trains_it_and_goes_on(tmp_path, rng, capsys):
    write_set(tmp_path / "data", {name: shot(rng, 3) for name in "ab"}, [0, 1, 2, 0, 1, 2])
    out, folders = str(tmp_path / "run"), f"data.folders={[str(tmp_path / 'data')]}"
    words = ["train", "--config", "temporal", "--out", out, "--set", folders, "--set", "data.validation=[]"]
    words += ["--set", "temporal.methods=['wcv']", "--set", "temporal.round=2", "--set", "run.log=1"]
    for steps, said in ((3, "validation: 1 of 2 scenes set aside"), (5, "at step 3 of 5")):
        assert main([*words, "--set", f"run.steps={steps}"]) == 0, capsys.readouterr().err
        assert said in (output := capsys.readouterr().out) and f"finished at step {steps}" in output
        assert "results frame by frame, by wcv" in output
    assert [entry["step"] for entry in log_of(tmp_path / "run") if "loss" in entry] == [1, 2, 3, 4, 5]
    assert "Finished" in (tmp_path / "run" / "run.html").read_text()
    assert main(["info", out]) == 0 and "validations: 2" in capsys.readouterr().out
