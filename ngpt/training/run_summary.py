"""Summarises the folder of a training run for ``ngpt info``, without PyTorch, also during the run."""

import json
import struct
from pathlib import Path
from typing import Any

from ngpt.errors import NgptError
from ngpt.network.identity import identify
from ngpt.network.training_log import LOG, entries_of
from ngpt.system.reading import regular_file
from ngpt.system.records import check, parse_json, read_json

CHECKPOINT, SETTINGS, WEIGHTS = "checkpoint.safetensors", "settings.json", "weights.safetensors"
PAGE = "run.html"
# The loss is averaged over this number of log entries, because the loss of one batch is noisy.
_RECENT = 10
# The largest header in bytes, far more than the names and shapes of tensors need.
_MAX_HEADER = 2**26


def is_run(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (CHECKPOINT, LOG))


def summary(folder: Path) -> dict[str, Any]:
    """Steps, time, losses and validation scores of a run, as a table for people and for JSON.

    Raises NgptError if checkpoint, settings or log cannot be read.
    """
    entries = entries_of(folder / LOG) if (folder / LOG).is_file() else []
    report: dict[str, Any] = {"training run": str(folder)}
    settings: Any = read_json(folder / SETTINGS) if (folder / SETTINGS).is_file() else {}
    if (folder / CHECKPOINT).is_file():
        header = _header(folder / CHECKPOINT)
        settings = settings or header["settings"]
        report |= {"checkpoint at step": header["step"], "hours until then": round(header["seconds"] / 3600, 3)}
        report |= {"version": header.get("version", "?")}
    if settings:
        check(settings, {"run": {"steps": int}}, f"{folder / SETTINGS}")
        report |= {"steps planned": settings["run"]["steps"]}
    if losses := [entry for entry in entries if "loss" in entry]:
        last, recent = losses[-1], losses[-_RECENT:]
        mean = sum(entry["loss"] for entry in recent) / len(recent)
        report |= {"logged until step": entries[-1]["step"]}
        report["loss"] = {"first": losses[0]["loss"], "last": last["loss"], f"mean of {len(recent)}": mean}
        report["last step"] = {name: value for name, value in last.items() if name != "loss"}
    if scores := [entry for entry in entries if "relMSE" in entry]:
        best = min(scores, key=lambda entry: entry["relMSE"])
        report |= {"validations": len(scores), "validation": {"best": best, "last": scores[-1]}}
    if (folder / WEIGHTS).is_file():
        report["weights"] = str(identify(folder / WEIGHTS))
    if (folder / PAGE).is_file():
        report["page"] = str(folder / PAGE)
    if bad := sorted(path.name for path in folder.glob("bad-batch-*.safetensors")):
        report["batches whose loss was not finite"] = bad
    return report


def _header(path: Path) -> dict[str, Any]:
    """The record in the header of a checkpoint. A safetensors file begins with the length of its JSON header."""
    try:
        with regular_file(path) as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > _MAX_HEADER:
                raise ValueError
            text = json.loads(file.read(length))["__metadata__"]["ngpt"]
    except (OSError, struct.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise NgptError(f"{path}: is no checkpoint of ngpt, or damaged") from error
    check(text, str, f"{path}: its header")
    header = parse_json(text, f"{path}: its header")
    check(header, {"settings": dict, "step": int, "seconds": (int, float)}, f"{path}: its header")
    return header
