"""Training: it learns, it can be stopped at any moment, and it explains what is wrong."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from crops import CROPS, SETTINGS, PairedCrop, SyntheticCrop, settings, trainer

import ngpt
from ngpt.errors import NgptError
from ngpt.network import safetensors
from ngpt.stack import GradientStack
from ngpt.training import examples
from ngpt.training.augment import Augmentation
from ngpt.training.crops import open_crops
from ngpt.training.loss import make_loss
from ngpt.training.schedule import learning_rate
from ngpt.training.settings import OptimizerSettings, from_dict, read_settings
from ngpt.training.trainer import published
from ngpt.windows import Place, Window

HERE = str(Path(__file__).parent)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run of a few steps, which is copied before it is changed."""
    out = tmp_path_factory.mktemp("finished")
    trainer(out).run()
    return out


@pytest.fixture
def done(finished, tmp_path):
    for name in ("checkpoint.safetensors", "weights.safetensors", "log.jsonl"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    return tmp_path


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.average.parameters(), other.average.parameters(), strict=True))


def test_it_learns_and_its_weights_can_be_used(tmp_path):
    run = trainer(tmp_path, run_steps=300, run_batch=4, run_validate=300, model_channels=[8, 8])
    assert run.run()
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    scores = next(entry for entry in reversed(log) if "relMSE" in entry)
    assert scores["relMSE"] < 0.5 * scores["relMSE primal"]
    assert (tmp_path / "validation-0000300.png").read_bytes().startswith(b"\x89PNG")
    # The method does what validation measured.
    crop = CROPS[5]
    image = ngpt.denoise(crop.stack(0), "ngpt", weights=str(tmp_path / "weights.safetensors"))
    error = np.mean((image - crop.reference) ** 2)
    assert error < 0.5 * np.mean((crop.stack(0)["primal"] - crop.reference) ** 2)


BOTH = {"data_pairs": 0.5, "loss": {"kind": "l1", "halves": 0.5}, "run_batch": 4, "optimizer_ema": 0.0}


@pytest.mark.parametrize(
    ("stop", "crops", "changes"),
    [(1, CROPS[:4], {}), (7, CROPS[:4], {}), (2, [CROPS[0], PairedCrop("b", 1)], BOTH)],
    ids=["at 1", "at 7", "with pairs"],
)
def test_a_stopped_run_continues_bit_for_bit(tmp_path, stop, crops, changes):
    chosen = {"crops": crops, "held_out": CROPS[4:], "run_steps": 9, **changes}
    if changes:
        chosen["loss"] = make_loss(changes["loss"])
    whole = trainer(tmp_path / "whole", **chosen)
    whole.run()
    part = trainer(tmp_path / "part", **chosen)
    assert not part.run(progress=lambda done, total: part._interrupt() if done == stop else None)
    rest = trainer(tmp_path / "part", **chosen)
    rest.resume()
    assert rest.step == stop
    rest.run()
    assert same(whole, rest)
    logs = [(tmp_path / name / "log.jsonl").read_text().splitlines() for name in ("whole", "part")]
    steps = [[json.loads(line)["step"] for line in log] for log in logs]
    assert steps[0] == steps[1]


def test_records_that_cannot_be_written_cost_no_step(tmp_path, monkeypatch):
    """A full disk: neither log nor checkpoint has room in the folder, and another place has."""
    out, other = tmp_path / "run", tmp_path / "other"
    other.mkdir()
    monkeypatch.chdir(other)
    run, write = trainer(out), safetensors.write_tensors

    def full(path, *args):
        if path.parent == out:
            raise NgptError(f"{path}: cannot be written: No space left on device")
        write(path, *args)

    def log(values):
        raise NgptError("log.jsonl: cannot be written: No space left on device")

    monkeypatch.setattr(run, "_log", log)
    monkeypatch.setattr(safetensors, "write_tensors", full)
    with pytest.raises(NgptError, match=rf"checkpoint.safetensors: .*kept in {other / 'checkpoint.kept.safetensors'}$"):
        run.run()
    assert run.step == run.settings.run.log
    (other / "checkpoint.kept.safetensors").rename(out / "checkpoint.safetensors")
    again = trainer(out)
    again.resume()
    assert again.step == run.step


def test_a_loss_that_is_not_finite_stops_it_and_keeps_the_batch(done):
    before = (done / "checkpoint.safetensors").read_bytes()
    run = trainer(done, loss=lambda prediction, target, generator: (prediction.mean() * float("nan"), {}))
    with pytest.raises(NgptError, match=r"step 0: the loss is nan.*bad-batch"):
        run.run()
    batch, header = safetensors.read_tensors(done / "bad-batch-0000000.safetensors")
    assert header["kind"] == "batch" and batch["target"].shape == (2, 3, 18, 18)
    assert run.checkpoint.read_bytes() == before


class CausticCrop(SyntheticCrop):
    """With light that gradients hold nothing of, in a layer of its own."""

    def __init__(self):
        super().__init__("caustic", 0)
        self.plain = self.reference
        self.reference_caustic = np.where(np.random.default_rng(1).random(self.reference.shape) > 0.9, 2, 0)
        self.reference_caustic = self.reference_caustic.astype(np.float32)
        self.reference = self.plain + self.reference_caustic

    def stack(self, k):
        stack, caustic = SyntheticCrop("caustic", 0).stack(k), self.reference_caustic
        return stack.replace(primal=stack["primal"] + caustic, caustic=caustic, caustic_var=0 * caustic)


@pytest.mark.parametrize("whole", [False, True])
def test_targets_hold_what_the_inputs_estimate(whole):
    """Networks with gradients make the image without the layer ``caustic``, all others the whole of it."""
    plain = {"network": "plain", "units": [], "inputs": ["primal", "albedo"], "start": ["primal"]}
    config = settings(model=SETTINGS["model"] | (plain if whole else {})).model
    crop = CausticCrop()
    drawn = examples.Examples([crop], config, Augmentation(quieter=(0.1, 0.5)), 32, seed=0)
    assert np.allclose(examples.target_of(crop, config), crop.reference if whole else crop.plain)
    for layers, judge in (drawn._layers(0, crop, k) for k in range(3)):
        assert float((layers["primal"] - judge["target"]).abs().max()) < 2


def test_folders_with_a_layer_that_the_reference_or_a_stack_lacks(tmp_path):
    crop, view = CausticCrop(), tmp_path / "view"
    view.mkdir()
    ngpt.write(view / "a.exr", crop.stack(0))
    ngpt.write(view / "reference.exr", crop.reference)
    estimate = open_crops(tmp_path)[0].reference_caustic
    assert estimate.sum(dtype=np.float64) == pytest.approx(crop.reference_caustic.sum(dtype=np.float64), rel=1e-4)
    ngpt.write(view / "reference.exr", crop.stack(1), overwrite=True)
    assert np.array_equal(open_crops(tmp_path)[0].reference_caustic, crop.reference_caustic)
    ngpt.write(view / "b.exr", SyntheticCrop("caustic", 0).stack(0))
    with pytest.raises(NgptError, match=r"b\.exr: has no layer 'caustic', but other stacks of view have"):
        _ = open_crops(tmp_path)[0].reference_caustic
    (view / "a.exr").unlink()
    assert not open_crops(tmp_path)[0].reference_caustic.any()


def test_folders_of_stacks_are_crops(tmp_path):
    crop, view = CROPS[0], tmp_path / "view"
    view.mkdir()
    with pytest.raises(NgptError, match="no folder in it holds"):
        open_crops(tmp_path)
    ngpt.write(view / "a.exr", crop.stack(0))
    with pytest.raises(NgptError, match=r"no reference\.exr"):
        open_crops(tmp_path)
    ngpt.write(view / "reference.exr", crop.reference)
    (read,) = open_crops(tmp_path)
    assert read.inputs == 1 and read.scene == "view" and np.allclose(read.reference, crop.reference)
    assert np.allclose(read.stack(0)["dx"], crop.stack(0)["dx"])
    there = Window(2, 0, *read.stack(0).place.data.size)
    moved = GradientStack(crop.stack(0).layers, place=Place(there, Window(0, 0, 99, 99)))
    other = GradientStack({"primal": crop.reference}, place=Place(replace(there, left=3), Window(0, 0, 99, 99)))
    ngpt.write(view / "a.exr", moved, overwrite=True)
    ngpt.write(view / "reference.exr", other, overwrite=True)
    with pytest.raises(NgptError, match=r"at \(2, 0\) of 99x99 but .*reference.exr is .* at \(3, 0\) of 99x99"):
        open_crops(tmp_path)


@pytest.mark.parametrize(
    ("step", "rate"),
    # The last from the facts sheet of the released code.
    [(0, 5e-8), (5_000, 5e-6), (10_000, 5e-4), (50_000, 5e-4), (120_000, 2.5e-4), (600_000, 2.2e-6)],
)
def test_the_papers_schedule(step, rate):
    assert learning_rate(OptimizerSettings(), step, 600_000) == pytest.approx(rate, rel=0.03)


def test_the_cosine_schedule():
    """A run that would end within its warm-up has one of a tenth of its steps; others keep theirs."""
    s = OptimizerSettings(learning_rate=1.0, schedule="cosine", warmup=10)
    rates = [learning_rate(s, i, 110) for i in range(110)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == 1 and rates[-1] == pytest.approx(0.01)
    assert all(a >= b for a, b in pairwise(rates[10:]))
    assert [learning_rate(s, i, 10) for i in range(2)] == [1, 1] and learning_rate(s, 8, 11) < 1


def test_settings_that_are_gone_do_not_stop_a_run(done, tmp_path):
    """Checkpoints of earlier versions hold them."""
    tensors, header = safetensors.read_tensors(done / "checkpoint.safetensors")
    header["settings"]["run"]["wandb"] = ""
    header["settings"]["augmentation"]["rarer"] = []
    (tmp_path / "run").mkdir()
    safetensors.write_tensors(tmp_path / "run" / "checkpoint.safetensors", tensors, header)
    again = trainer(tmp_path / "run")
    again.resume()
    assert again.step == 12


def test_a_run_says_what_has_changed_since_its_checkpoint(done):
    with pytest.raises(NgptError, match=r"another \[model\]"):
        trainer(done, model_units=[2, 1]).resume()
    said = []
    other = trainer(done, run_steps=14, optimizer_learning_rate=0.125)
    other.say = said.append
    other.resume()
    assert [line for line in said if "changed" in line] == [
        "changed since the checkpoint: optimizer.learning_rate: 0.01 -> 0.125",
        "changed since the checkpoint: run.steps: 12 -> 14",
    ]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("run.stepz=7", "unknown key 'stepz'"),
        ("run.steps=many", "steps = 'many': must be a whole number, like 600000"),
        ("run.steps=0", "at least 1"),
        ("model.channels=[1.5]", r"\[model\]: channels = \[1.5\]: must be a list of whole numbers"),
        ("augmentation.depth=[1]", r"depth = \[1\]: must be a list of 2 numbers, like \[0.1, 1.1\]"),
        ("model=3", r"a\.toml: \[model\] = 3: must be a table"),
        ("optimizer.schedule=steep", "choose one of"),
        ("optimizer.ema=1.0", "below 1"),
        ("data.pairs=1.0", r"data.pairs = 1.0: must be a share"),
        ("runs.steps=7", "unknown key 'runs'"),
        ("run", r"table\.key=value"),
        ("model.inputs=['primal', 'x']", "input 'x'"),
        # References are not split, so inputs that are made up would have no parts.
        ("augmentation.quieter=[1.0, 1.0]", "augmentation.quieter: cannot be used .* reads diffuse and specular"),
    ],
)
def test_settings_are_checked(tmp_path, change, complaint):
    path = tmp_path / "a.toml"
    path.write_text(
        '[model]\nnetwork = "plain"\nchannels = [4]\nunits = []\ninputs = ["primal", "diffuse", "specular"]\n'
    )
    assert read_settings(path, ["run.steps=7", "optimizer.schedule=cosine"]).run.steps == 7
    with pytest.raises(NgptError, match=complaint):
        read_settings(path, [change])
    path.write_text("[model\n")
    with pytest.raises(NgptError, match=r"a\.toml: cannot be read"):
        read_settings(path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"data_crop": 31}, "divisible by 2"),
        ({"crops": []}, "no crops"),
        ({"data_crop": 64}, "smaller than the 64"),
    ],
)
def test_runs_that_cannot_work_are_refused(tmp_path, changes, complaint):
    with pytest.raises(NgptError, match=complaint):
        trainer(tmp_path, **changes).run()


def test_fine_tuning_starts_from_weights(done):
    path = str(done / "weights.safetensors")
    tensors, header = safetensors.read_tensors(path)
    assert all(torch.equal(t, tensors[n]) for n, t in trainer(done, initial=path).model.state_dict().items())
    safetensors.write_tensors(path, safetensors.in_halves(tensors, ""), header, overwrite=True)
    for name, tensor in trainer(done, initial=path).model.state_dict().items():
        assert tensor.dtype == torch.float32 and torch.equal(tensor, tensors[name].half().float())
    with pytest.raises(NgptError, match=r"differs from \[model\] of the run"):
        trainer(done, initial=path, model_units=[2, 2])


BIAS = "network.head.convolution.bias"


@pytest.mark.parametrize(
    ("tensors", "header", "complaint"),
    [
        ({BIAS: torch.zeros(4)}, {}, rf"tensor '{BIAS}' is \[4\], the model's is \[3\]"),
        ({BIAS: torch.full((3,), torch.nan)}, {}, "not finite"),
        ({BIAS: torch.zeros(3, dtype=torch.int32)}, {}, r"is of type torch\.int32"),
        ({"network.surplus": torch.zeros(1)}, {}, "unexpected tensor 'network.surplus'"),
        ({BIAS: None}, {}, f"lacks tensor '{BIAS}'"),
        ({}, {"format": 99}, "format 99"),
        ({}, {"kind": "checkpoint"}, "holds a checkpoint"),
        ({}, {"units": [1, 10**6]}, r"units \[1, 1000000\]: give a positive number, up to 32"),
        ({}, {"channels": [4, 10**9]}, "up to 1024"),
        ({}, {"channels": [4] * 20, "units": [1] * 20}, "at most 8 levels"),
        # Allowed, and two gigabytes: refused before they are taken.
        ({}, {"channels": [1024] * 2, "units": [8, 8]}, "is \\[.*the model's is|lacks tensor|unexpected tensor"),
    ],
)
def test_damaged_weights_are_explained(done, tensors, header, complaint):
    path = done / "weights.safetensors"
    own, told = safetensors.read_tensors(path)
    changed = {name: tensor for name, tensor in (own | tensors).items() if tensor is not None}
    told |= header if header.keys() <= {"format", "kind"} else {"model": told["model"] | header}
    safetensors.write_tensors(path, changed, told, overwrite=True)
    with pytest.raises(NgptError, match=complaint) as caught:
        safetensors.load_weights(path)
    assert str(path) in str(caught.value)


def test_weights_that_are_cut_or_not_there_are_explained(done):
    path = done / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(NgptError, match="not a readable safetensors file"):
        safetensors.load_weights(path)
    with pytest.raises(NgptError, match="no such file"):
        ngpt.denoise(CROPS[0].stack(0), "ngpt", weights=str(done / "nothing"))


@pytest.mark.parametrize(
    ("moment", "header", "complaint"),
    [
        (lambda tensor: torch.zeros(7), {}, r"is \[7\], the model's is"),
        (lambda tensor: tensor, {"step": "many"}, "its header: 'step' is 'many'; it must be int"),
    ],
)
def test_checkpoints_that_do_not_fit_are_explained(done, moment, header, complaint):
    path = done / "checkpoint.safetensors"
    tensors, told = safetensors.read_tensors(path)
    name = f"adam2/{BIAS}"
    safetensors.write_tensors(path, tensors | {name: moment(tensors[name])}, told | header, overwrite=True)
    with pytest.raises(NgptError, match=complaint) as caught:
        trainer(done).resume()
    assert str(path) in str(caught.value)


@pytest.mark.slow
def test_two_processes_do_what_one_does(tmp_path):
    """Gradients of two processes with half the batch each, averaged, are those of one; their examples are the same."""
    program = (
        "import sys; from pathlib import Path; sys.path[:0] = [sys.argv[2]]; import crops as t;"
        "r = t.trainer(Path(sys.argv[1]), loss=lambda p, q, g: ((p - q).abs().mean(), {}), run_steps=3);"
        "r.run(); r.processes.close()"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(HERE).parents[1]), "OMP_NUM_THREADS": "1"}
    (tmp_path / "run.py").write_text(program)
    one = [sys.executable, str(tmp_path / "run.py"), str(tmp_path / "one"), HERE]
    two = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", one[1], str(tmp_path / "two"), HERE]
    for command in (one, two):
        subprocess.run(command, env=environment, check=True)
    ours, theirs = (safetensors.read_tensors(tmp_path / name / "weights.safetensors")[0] for name in ("one", "two"))
    assert all(torch.allclose(ours[name], theirs[name], rtol=1e-3, atol=1e-4) for name in ours)


def test_weights_do_not_tell_where_things_lie():
    values = SETTINGS | {"initial": "/home/me/a.safetensors", "loss": {"kind": "l1", "backbone": "/home/me/b.pth"}}
    values["data"] = SETTINGS["data"] | {"folders": ["/home/me/views"]}
    told = published(from_dict(values, "test"))
    assert told["data"]["folders"] == ["views"] and told["initial"] == "a.safetensors" and "/" not in str(told["loss"])
