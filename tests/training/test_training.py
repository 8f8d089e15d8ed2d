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
from crops import SyntheticCrop
from runs import CROPS, SETTINGS, loss, settings, trainer

import ngpt
from ngpt.errors import NgptError
from ngpt.network import weights
from ngpt.stack import GradientStack
from ngpt.training import examples, folders
from ngpt.training.augment import Augmentation
from ngpt.training.schedule import learning_rate
from ngpt.training.settings import OptimizerSettings, from_dict, read_settings
from ngpt.training.trainer import Trainer, published
from ngpt.windows import Place, Window

HERE = str(Path(__file__).parent)


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


@pytest.mark.parametrize("stop", [1, 5, 7])
def test_a_stopped_run_continues_bit_for_bit(tmp_path, stop):
    whole = trainer(tmp_path / "whole")
    whole.run()
    part = trainer(tmp_path / "part")
    losses = iter(range(stop))

    def train(batch, original=part._train):
        entry = original(batch)
        if next(losses, None) == stop - 1:
            part._interrupt()
        return entry

    part._train = train
    assert not part.run()
    rest = trainer(tmp_path / "part")
    rest.resume()
    assert rest.step == stop
    rest.run()
    for a, b in zip(whole.average.parameters(), rest.average.parameters(), strict=True):
        assert torch.equal(a, b)
    logs = [(tmp_path / name / "log.jsonl").read_text().splitlines() for name in ("whole", "part")]
    steps = [[json.loads(line)["step"] for line in log] for log in logs]
    assert steps[0] == steps[1]


def test_records_that_cannot_be_written_cost_no_step(tmp_path, monkeypatch):
    """A full disk: neither log nor checkpoint has room in the folder, and another place has."""
    out, other = tmp_path / "run", tmp_path / "other"
    for folder in (out, other):
        folder.mkdir()
    monkeypatch.chdir(other)
    run, write = trainer(out), weights.write_tensors

    def full(path, *args):
        if path.parent == out:
            raise NgptError(f"{path}: cannot be written: No space left on device")
        write(path, *args)

    def log(values):
        raise NgptError("log.jsonl: cannot be written: No space left on device")

    monkeypatch.setattr(run, "_log", log)
    monkeypatch.setattr(weights, "write_tensors", full)
    with pytest.raises(NgptError, match=rf"checkpoint.safetensors: .*kept in {other / 'checkpoint.kept.safetensors'}$"):
        run.run()
    assert run.step == run.settings.run.log
    (other / "checkpoint.kept.safetensors").rename(out / "checkpoint.safetensors")
    again = trainer(out)
    again.resume()
    assert again.step == run.step


def test_a_loss_that_is_not_finite_stops_it_and_keeps_the_batch(tmp_path):
    run = trainer(tmp_path)
    run.run()
    before = run.checkpoint.read_bytes()
    run = trainer(tmp_path)
    run.loss = lambda prediction, target, generator: (prediction.mean() * float("nan"), {})
    with pytest.raises(NgptError, match=r"step 0: the loss is nan.*bad-batch"):
        run.run()
    batch, header = weights.read_tensors(tmp_path / "bad-batch-0000000.safetensors")
    assert header["kind"] == "batch" and batch["target"].shape == (2, 3, 18, 18)
    assert run.checkpoint.read_bytes() == before


def test_examples_depend_on_nothing_but_their_index():
    s = settings()
    make = lambda: examples.Examples(CROPS, s.model, Augmentation(), 24, seed=3)  # noqa: E731
    forward, backward = make(), make()
    a = [forward[i] for i in range(4)]
    b = [backward[i] for i in reversed(range(4))][::-1]
    for x, y in zip(a, b, strict=True):
        assert all(torch.equal(x[name], y[name]) for name in x)
    assert a[0]["primal"].shape == (3, 40, 40) and a[0]["target"].shape == (3, 10, 10)
    assert not torch.equal(a[0]["primal"], a[1]["primal"])


def test_the_target_is_where_the_input_is():
    s = settings()
    crop = SyntheticCrop("clean", 0)
    crop.spp = (10**12, 10**12)
    drawn = examples.Examples([crop], s.model, Augmentation(), 32, seed=0)
    for i in range(5):
        example = drawn[i]
        assert torch.allclose(example["primal"][:, 15:-15, 15:-15], example["target"], rtol=1e-3, atol=1e-3)


class CausticCrop(SyntheticCrop):
    """With light that gradients hold nothing of, in a layer of its own."""

    def __init__(self):
        super().__init__("caustic", 0)
        self.plain = self.reference
        self.reference_caustic = np.where(np.random.default_rng(1).random(self.reference.shape) > 0.9, 2, 0)
        self.reference_caustic = self.reference_caustic.astype(np.float32)
        self.reference = self.plain + self.reference_caustic

    def stack(self, k):
        stack = SyntheticCrop("caustic", 0).stack(k)
        caustic = self.reference_caustic
        return stack.replace(primal=stack["primal"] + caustic, caustic=caustic, caustic_var=0 * caustic)


def test_targets_hold_what_the_inputs_estimate():
    """Networks with gradients make the image without the layer ``caustic``, all others the whole of it."""
    plain = {"network": "plain", "units": [], "inputs": ["primal", "albedo"], "start": ["primal"]}
    whole = from_dict({"model": SETTINGS["model"] | plain}, "test").model
    for config, with_layer in ((settings().model, False), (whole, True)):
        crop = CausticCrop()
        drawn = examples.Examples([crop], config, Augmentation(quieter=(0.1, 0.5)), 32, seed=0)
        target = examples.target_of(crop, config)
        assert np.allclose(target, crop.reference if with_layer else crop.plain)
        parts = [drawn._layers(0, drawn.crops[0], k) for k in range(3)]
        errors = [layers["primal"] - judge["target"] for layers, judge in parts]
        assert max(float(error.abs().max()) for error in errors) < 2


def test_folders_with_a_layer_that_the_reference_or_a_stack_lacks(tmp_path):
    crop, view = CausticCrop(), tmp_path / "view"
    view.mkdir()
    ngpt.write(view / "a.exr", crop.stack(0))
    ngpt.write(view / "reference.exr", crop.reference)
    estimate = folders.open_crops(tmp_path)[0].reference_caustic
    assert estimate.sum(dtype=np.float64) == pytest.approx(crop.reference_caustic.sum(dtype=np.float64), rel=1e-4)
    stack = crop.stack(1)
    ngpt.write(view / "reference.exr", stack, overwrite=True)
    assert np.array_equal(folders.open_crops(tmp_path)[0].reference_caustic, crop.reference_caustic)
    ngpt.write(view / "b.exr", SyntheticCrop("caustic", 0).stack(0))
    with pytest.raises(NgptError, match=r"b\.exr: has no layer 'caustic', but other stacks of view have"):
        _ = folders.open_crops(tmp_path)[0].reference_caustic
    (view / "a.exr").unlink()
    assert not folders.open_crops(tmp_path)[0].reference_caustic.any()


def test_folders_of_stacks_are_crops(tmp_path):
    crop = CROPS[0]
    (tmp_path / "view").mkdir()
    with pytest.raises(NgptError, match="no folder in it holds"):
        folders.open_crops(tmp_path)
    ngpt.write(tmp_path / "view" / "a.exr", crop.stack(0))
    with pytest.raises(NgptError, match=r"no reference\.exr"):
        folders.open_crops(tmp_path)
    ngpt.write(tmp_path / "view" / "reference.exr", crop.reference)
    (read,) = folders.open_crops(tmp_path)
    assert read.inputs == 1 and read.scene == "view"
    assert np.allclose(read.reference, crop.reference)
    assert np.allclose(read.stack(0)["dx"], crop.stack(0)["dx"])
    with pytest.raises(NgptError, match="no such folder"):
        folders.open_crops(tmp_path / "nowhere")
    there = Window(2, 0, *read.stack(0).place.data.size)
    moved = GradientStack(crop.stack(0).layers, place=Place(there, Window(0, 0, 99, 99)))
    other = GradientStack({"primal": crop.reference}, place=Place(replace(there, left=3), Window(0, 0, 99, 99)))
    ngpt.write(tmp_path / "view" / "a.exr", moved, overwrite=True)
    ngpt.write(tmp_path / "view" / "reference.exr", other, overwrite=True)
    with pytest.raises(NgptError, match=r"at \(2, 0\) of 99x99 but .*reference.exr is .* at \(3, 0\) of 99x99"):
        folders.open_crops(tmp_path)


def test_the_papers_schedule():
    paper = OptimizerSettings()
    assert learning_rate(paper, 0, 600_000) == pytest.approx(5e-8)
    assert learning_rate(paper, 5_000, 600_000) == pytest.approx(5e-6)
    assert learning_rate(paper, 10_000, 600_000) == learning_rate(paper, 50_000, 600_000) == 5e-4
    assert learning_rate(paper, 120_000, 600_000) == pytest.approx(2.5e-4)
    # The facts sheet of the released code: 2.2e-6 at the end.
    assert learning_rate(paper, 600_000, 600_000) == pytest.approx(2.2e-6, rel=0.03)


@pytest.mark.parametrize("schedule", ("paper", "cosine"))
def test_a_short_run_reaches_its_learning_rate(schedule):
    """A run that would end within its warm-up has one of a tenth of its steps; others keep theirs."""
    s = OptimizerSettings(learning_rate=1.0, schedule=schedule, warmup=100)
    rates = [learning_rate(s, i, 30) for i in range(30)]
    assert max(rates[:5]) == 1 and rates[0] < 1
    assert max(learning_rate(s, i, 101) for i in range(99)) < 1


def test_a_run_says_what_has_changed_since_its_checkpoint(tmp_path):
    trainer(tmp_path, run_steps=2).run()
    said = []
    other = trainer(tmp_path, run_steps=4, optimizer_learning_rate=0.125)
    other.say = said.append
    other.resume()
    assert [line for line in said if "changed" in line] == [
        "changed since the checkpoint: optimizer.learning_rate: 0.01 -> 0.125",
        "changed since the checkpoint: run.steps: 2 -> 4",
    ]


def test_settings_are_checked(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[model]\nnetwork = "plain"\nchannels = [4]\nunits = []\ninputs = ["primal"]\n')
    assert read_settings(path, ["run.steps=7", "optimizer.schedule=cosine"]).run.steps == 7
    for change, complaint in [
        ("run.stepz=7", "unknown key 'stepz'"),
        ("run.steps=many", "steps = 'many': must be a whole number, like 600000"),
        ("run.steps=0", "at least 1"),
        ("model.channels=[1.5]", r"\[model\]: channels = \[1.5\]: must be a list of whole numbers"),
        ("augmentation.depth=[1]", r"depth = \[1\]: must be a list of 2 numbers, like \[0.1, 1.1\]"),
        ("model=3", r"a\.toml: \[model\] = 3: must be a table"),
        ("optimizer.schedule=steep", "choose one of"),
        ("optimizer.ema=1.0", "below 1"),
        ("runs.steps=7", "unknown key 'runs'"),
        ("run", r"table\.key=value"),
        ("model.inputs=['primal', 'x']", "input 'x'"),
    ]:
        with pytest.raises(NgptError, match=complaint):
            read_settings(path, [change])
    path.write_text("[model\n")
    with pytest.raises(NgptError, match=r"a\.toml: cannot be read"):
        read_settings(path)


def test_runs_that_cannot_work_are_refused(tmp_path):
    with pytest.raises(NgptError, match="divisible by 2"):
        trainer(tmp_path, data_crop=31)
    with pytest.raises(NgptError, match="no crops"):
        trainer(tmp_path, crops=[])
    with pytest.raises(NgptError, match="smaller than the 64"):
        trainer(tmp_path, data_crop=64).run()
    trainer(tmp_path, run_steps=1).run()
    with pytest.raises(NgptError, match=r"another \[model\]"):
        trainer(tmp_path, model_units=[2, 1]).resume()


def test_fine_tuning_starts_from_weights(tmp_path):
    first = trainer(tmp_path / "a", run_steps=3)
    first.run()
    values = json.loads(json.dumps(SETTINGS)) | {"initial": str(tmp_path / "a" / "weights.safetensors")}
    (tmp_path / "b").mkdir()
    second = Trainer(from_dict(values, "test"), CROPS[:4], [], loss, tmp_path / "b", say=lambda text: None)
    for a, b in zip(first.average.parameters(), second.model.parameters(), strict=True):
        assert torch.equal(a, b)
    tensors, header = weights.read_tensors(values["initial"])
    weights.write_tensors(values["initial"], weights.in_halves(tensors, ""), header, overwrite=True)
    third = Trainer(from_dict(values, "test"), CROPS[:4], [], loss, tmp_path / "b", say=lambda text: None)
    for a, b in zip(first.average.parameters(), third.model.parameters(), strict=True):
        assert b.dtype == torch.float32 and torch.equal(a.half().float(), b)
    values["model"]["units"] = [2, 2]
    with pytest.raises(NgptError, match=r"another \[model\]"):
        Trainer(from_dict(values, "test"), CROPS[:4], [], loss, tmp_path / "b")


def test_damaged_weights_are_explained(tmp_path):
    run = trainer(tmp_path, run_steps=1)
    run.run()
    path = tmp_path / "weights.safetensors"
    tensors, header = weights.read_tensors(path)
    name = "network.head.convolution.bias"
    for change, complaint in [
        ({name: torch.zeros(4)}, r"tensor 'network.head.convolution.bias' is \[4\], the model's is \[3\]"),
        ({name: torch.full((3,), torch.nan)}, "not finite"),
        ({"network.surplus": torch.zeros(1)}, "unexpected tensor 'network.surplus'"),
    ]:
        weights.write_tensors(path, tensors | change, header, overwrite=True)
        with pytest.raises(NgptError, match=complaint):
            weights.load_weights(path)
    weights.write_tensors(path, {k: v for k, v in tensors.items() if k != name}, header, overwrite=True)
    with pytest.raises(NgptError, match=r"lacks tensor 'network.head.convolution.bias'"):
        weights.load_weights(path)
    weights.write_tensors(path, tensors, header | {"format": 99}, overwrite=True)
    with pytest.raises(NgptError, match="format 99"):
        weights.load_weights(path)
    model = header["model"]
    for change, complaint in [
        ({"units": [1, 10**6]}, r"units \[1, 1000000\]: give a positive number, up to 32"),
        ({"channels": [4, 10**9]}, "up to 1024"),
        ({"channels": [4] * 20, "units": [1] * 20}, "at most 8 levels"),
        ({"channels": [4.0, True]}, "give a positive number"),
        # Allowed, and two gigabytes: refused before they are taken.
        ({"channels": [1024] * 2, "units": [8, 8]}, "is \\[.*the model's is|lacks tensor|unexpected tensor"),
        ({"network": ["dense"]}, "network"),
    ]:
        weights.write_tensors(path, tensors, header | {"model": model | change}, overwrite=True)
        with pytest.raises(NgptError, match=complaint) as caught:
            weights.load_weights(path)
        assert str(path) in str(caught.value)
    weights.write_tensors(path, tensors | {name: torch.zeros(3, dtype=torch.int32)}, header, overwrite=True)
    with pytest.raises(NgptError, match=r"is of type torch\.int32"):
        weights.load_weights(path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(NgptError, match="not a readable safetensors file"):
        weights.load_weights(path)
    with pytest.raises(NgptError, match="holds a checkpoint"):
        weights.load_weights(tmp_path / "checkpoint.safetensors")
    with pytest.raises(NgptError, match="no such file"):
        ngpt.denoise(CROPS[0].stack(0), "ngpt", weights=str(tmp_path / "nothing"))


def test_checkpoints_that_do_not_fit_are_explained(tmp_path):
    trainer(tmp_path, run_steps=1).run()
    path = tmp_path / "checkpoint.safetensors"
    tensors, header = weights.read_tensors(path)
    moment = next(name for name in tensors if name.startswith("adam2/"))
    for changed, told, complaint in [
        (tensors | {moment: torch.zeros(7)}, header, r"is \[7\], the model's is"),
        (tensors | {moment: tensors[moment] * torch.nan}, header, "not finite"),
        ({n: t for n, t in tensors.items() if n != moment}, header, "lacks tensor"),
        ({}, header, "lacks tensor"),
        (tensors, header | {"step": "many"}, "its header: 'step' is 'many'; it must be int"),
        (tensors, {k: v for k, v in header.items() if k != "settings"}, "its header: lacks 'settings'"),
    ]:
        weights.write_tensors(path, changed, told, overwrite=True)
        with pytest.raises(NgptError, match=complaint) as caught:
            trainer(tmp_path, run_steps=1).resume()
        assert str(path) in str(caught.value)


@pytest.mark.slow
def test_two_processes_do_what_one_does(tmp_path):
    """Gradients of two processes with half the batch each, averaged, are those of one; their examples are the same."""
    program = (
        "import sys; from pathlib import Path; sys.path[:0] = [sys.argv[2]]; import runs as t;"
        "t.loss = lambda p, q, g: ((p - q).abs().mean(), {});"
        "r = t.trainer(Path(sys.argv[1]), run_steps=3); r.run(); r.processes.close()"
    )
    environment = os.environ | {"PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"}
    (tmp_path / "run.py").write_text(program)
    one = [sys.executable, str(tmp_path / "run.py"), str(tmp_path / "one"), HERE]
    two = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", one[1], str(tmp_path / "two"), HERE]
    subprocess.run(one, env=environment, check=True)
    subprocess.run(two, env=environment, check=True)
    ours, _ = weights.read_tensors(tmp_path / "one" / "weights.safetensors")
    theirs, _ = weights.read_tensors(tmp_path / "two" / "weights.safetensors")
    assert all(torch.allclose(ours[name], theirs[name], rtol=1e-3, atol=1e-4) for name in ours)


def test_weights_do_not_tell_where_things_lie(tmp_path):
    values = SETTINGS | {"initial": "/home/me/a.safetensors", "loss": {"kind": "l1", "backbone": "/home/me/b.pth"}}
    values["data"] = SETTINGS["data"] | {"folders": ["/home/me/views"]}
    told = published(from_dict(values, "test"))
    assert told["data"]["folders"] == ["views"] and told["initial"] == "a.safetensors" and "/" not in str(told["loss"])


def test_the_cosine_schedule():
    s = OptimizerSettings(learning_rate=1.0, schedule="cosine", warmup=10)
    rates = [learning_rate(s, i, 110) for i in range(110)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == 1 and rates[-1] == pytest.approx(0.01)
    assert all(a >= b for a, b in pairwise(rates[10:]))
