"""Writes ``run.json``: the settings of a run that differ from its configuration, and the machine that it runs on."""

from pathlib import Path
from typing import Any

import torch
from torch import nn

from ngpt.network.model import parameters
from ngpt.system import configs
from ngpt.system.limits import processors
from ngpt.system.machine import metadata
from ngpt.system.writing import write_json
from ngpt.training.run_page import RECORD
from ngpt.training.settings import Settings, published, read_settings
from ngpt.training.settings_text import difference, flat


def write_record(out: Path, settings: Settings, config: Path, model: nn.Module, device: torch.device) -> None:
    """Writes the record into the folder ``out``, with the names of folders but not their paths.

    Its entry "base" is the configuration ``config``, or the nearest one of ngpt if ``config`` is a user's own file.
    """
    base, changed = nearest(settings, config)
    system: dict[str, Any] = metadata("torch", "numpy", "safetensors")
    system |= {"device": str(device), "threads": torch.get_num_threads(), "processors": processors()}
    system |= {name: found for name, found in system.pop("versions").items() if found}
    if device.type == "cuda":
        system["gpu"] = torch.cuda.get_device_name(device)
    record = {"base": base, "changed": changed}
    write_json(out / RECORD, record | {"parameters": parameters(model), "system": system})


def nearest(settings: Settings, config: Path) -> tuple[str, dict[str, list]]:
    """The nearest configuration of ngpt, and the settings that differ: name -> [its value, value of the run]."""
    shipped = config.parent == configs.FOLDER
    names = [config.stem] if shipped else configs.names(configs.TRAINING)
    here = flat(published(settings))
    found = []
    for name in names:
        there = flat(published(read_settings(configs.FOLDER / f"{name}.toml")))
        found.append((name, {key: [there.get(key), here.get(key)] for key in difference(there, here)}))
    return min(found, key=lambda one: len(one[1]))
