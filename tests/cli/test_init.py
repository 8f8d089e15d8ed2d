"""--init of train, dataset and evaluate: a configuration of one's own, with all that could be set."""

import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest

from ngpt.system import configs

pytest.importorskip("torch")

from data_gen.dataset.config import read_config as read_data
from ngpt.evaluation.config import read_config as read_evaluation
from ngpt.system.templates import template
from ngpt.training.loss import make_loss
from ngpt.training.settings import RunSettings, read_settings

KINDS = {"train": configs.TRAINING, "dataset": configs.DATASET, "evaluate": configs.EVALUATION}
READERS = {"train": read_settings, "dataset": read_data, "evaluate": read_evaluation}
ON_A_BASE = {("evaluate", "eval-640")}
ALL = [(verb, name) for verb, kind in KINDS.items() for name in configs.names(kind) if (verb, name) not in ON_A_BASE]


@pytest.mark.parametrize(("verb", "name"), ALL)
def test_it_is_the_configuration_and_offers_all_that_could_be_set(verb, name, tmp_path, command):
    """Read back it gives the same settings, and again with everything that it offers."""
    path, offered = tmp_path / "mine.toml", tmp_path / "offered.toml"
    assert f"ngpt {verb} --config mine.toml --out DIR" in command(f"{verb} --config {name} --init mine.toml").err
    read, text = READERS[verb], path.read_text()
    given = read(configs.find_config(name, KINDS[verb]))
    assert read(path) == given
    offers = {key or table for key, table in re.findall(r"^(?:# )?(\w+) = |^\[+(\w+)", text, re.M)}
    parts = [value for name, value in vars(given).items() if is_dataclass(value) and name in offers] or [given]
    keys = {field.name for part in parts for field in fields(part) if getattr(part, field.name) is not None}
    assert keys - offers <= {"sampler_options"}
    offered.write_text(re.sub(r"^# (\w+ = .*)$", r"\1", text, flags=re.M))
    assert offered.read_text() != text
    everything = read(offered)
    if verb == "train":
        assert make_loss(everything.loss).settings == make_loss(given.loss).settings
        everything, given = replace(everything, loss={}), replace(given, loss={})
    assert everything == given


def test_what_is_said_of_a_table_stays_above_it():
    text = "steps = 3\n\n[run]\nlog = 1\n\n# Of its own.\n[variants.mine]\nmethod = 2\n"
    made = template(text, {"": None, "run": RunSettings, "variants": None})
    assert "\n\n# Of its own.\n[variants.mine]\nmethod = 2\n" in made and made.index("# save =") < made.index(
        "# Of its"
    )


@pytest.mark.parametrize("verb", KINDS)
def test_without_a_configuration_it_begins_with_one_that_is_shipped(verb, command):
    command(f"{verb} --init mine.toml")
    assert READERS[verb]("mine.toml") == READERS[verb](configs.find_config(configs.STARTS[KINDS[verb]], KINDS[verb]))
    assert "--out is missing" in command(f"{verb} --config mine.toml", 2).err
    assert [path.name for path in Path().iterdir()] == ["mine.toml"]
