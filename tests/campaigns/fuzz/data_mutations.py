"""Broken manifests, shards, weights, checkpoints, settings and networks: whole ones with something wrong with them."""

import json
import random
import struct
from typing import Any

from exr_mutations import RAW

DEPTH = 100_000


class Nested:
    """Stands for brackets within brackets, which parsers of JSON and TOML recurse into."""


VALUES = (None, True, False, -1, 0, 1, 3, 2**31, 2**63, -(2**63), 10**400, 0.5, -1.5, 1e308, float("nan"), float("inf"))
VALUES += ("", "x", "x" * 5000, "a\nb", "\ud800", "../../../etc/passwd", "/etc/passwd", "..", "F32", "I64", "BF16")
VALUES += ([], {}, [0], [1, 2], [-1], [1e9], ["x"], {"x": 1}, [[]], [None], [2**40] * 3, list(range(1000)), Nested)


def value_changed(rng: random.Random, value: Any) -> Any:
    """A JSON value with one of its nodes replaced, dropped, doubled or renamed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        copy, key = dict(value), rng.choice(list(value))
        match rng.randrange(8):
            case 0:
                del copy[key]
            case 1:
                copy[rng.choice(("x", "", "é", "../x", "y" * 300))] = copy.pop(key)
            case 2:
                copy[rng.choice(("x", "__class__"))] = rng.choice(VALUES)
            case _:
                copy[key] = value_changed(rng, value[key])
        return copy
    if isinstance(value, list) and value and rng.random() < 0.9:
        place = rng.randrange(len(value))
        match rng.randrange(8):
            case 0:
                return value[:place] + value[place + 1 :]
            case 1:
                return [*value, value[place]]
        return [value_changed(rng, item) if i == place else item for i, item in enumerate(value)]
    return rng.choice(VALUES)


def to_json(value: Any) -> bytes:
    """With what Python's writer refuses: brackets without end."""
    text = json.dumps(value, default=lambda nested: "<nested>")
    return text.replace('"<nested>"', "[" * DEPTH + "]" * DEPTH).encode("utf-8", "surrogatepass")


def to_toml(value: dict[str, Any]) -> bytes:
    """Tables of scalars and lists, and lists of such tables."""
    lines, tables = [], []
    for name, item in value.items():
        if isinstance(item, dict):
            tables.append(f"[{json.dumps(name)}]\n" + to_toml(item).decode("utf-8", "surrogatepass"))
        else:
            text = to_json(item).decode("utf-8", "surrogatepass").replace("null", "nan")
            lines.append(f"{json.dumps(name)} = {text.replace('NaN', 'nan').replace('Infinity', 'inf')}\n")
    return "".join(lines + tables).encode("utf-8", "surrogatepass")


def bytes_changed(rng: random.Random, data: bytes) -> bytes:
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(RAW)(rng, data)
    return data


def safetensors_changed(rng: random.Random, data: bytes) -> bytes:
    """The header of the file, the record in its metadata, lengths, or the numbers themselves."""
    length = struct.unpack_from("<Q", data)[0]
    header, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    for _ in range(rng.choice((1, 1, 2))):
        match rng.randrange(6):
            case 0:
                header = value_changed(rng, header)
            case 1 | 2:
                record = header.get("__metadata__", {}) if isinstance(header, dict) else {}
                if isinstance(record, dict) and isinstance(record.get("ngpt"), str):
                    try:
                        changed = to_json(value_changed(rng, json.loads(record["ngpt"])))
                    except (ValueError, RecursionError):
                        continue
                    record["ngpt"] = changed.decode("utf-8", "replace")
            case 3:
                place = rng.randrange(len(body) // 4) * 4
                body[place : place + 4] = rng.choice(
                    (b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\xff\xff", b"\0\0\x80\xff")
                )
            case 4:
                body = body[: rng.randrange(len(body) + 1)]
            case 5:
                tensors = [name for name in header if name != "__metadata__"] if isinstance(header, dict) else []
                if len(tensors) > 1:
                    a, b = rng.sample(tensors, 2)
                    header[a], header[b] = header[b], header[a]
    text = to_json(header)
    size = len(text) if rng.random() < 0.95 else rng.choice((0, 2**63, 2**27, len(text) - 1, len(text) + 5))
    data = struct.pack("<Q", size) + text + bytes(body)
    return bytes_changed(rng, data) if rng.random() < 0.1 else data
