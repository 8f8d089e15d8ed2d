"""Breaks manifests, shards, weights, settings and networks: each function changes something in a whole one.

Every change is drawn from a ``random.Random``, which Hypothesis provides: it tries many, and finds a small one that
fails.
"""

import json
import struct
from random import Random
from typing import Any

DEPTH = 100_000


class Nested:
    """Stands for brackets within brackets, which parsers of JSON recurse into."""


VALUES = (None, True, False, -1, 0, 1, 3, 2**31, 2**63, -(2**63), 10**400, 0.5, -1.5, 1e308, float("nan"), float("inf"))
VALUES += ("", "x", "x" * 5000, "a\nb", "\ud800", "../../../etc/passwd", "/etc/passwd", "..", "F32", "I64", "BF16")
VALUES += ([], {}, [0], [1, 2], [-1], [1e9], ["x"], {"x": 1}, [[]], [None], [2**40] * 3, list(range(1000)), Nested)
KEYS = ("x", "", "é", "../x", "__class__", "y" * 300)


def value_changed(rng: Random, value: Any) -> Any:
    """A JSON value with one of its nodes replaced, dropped, doubled or renamed."""
    if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
        return rng.choice(VALUES)
    copy = value.copy()
    place = rng.choice(list(copy)) if isinstance(copy, dict) else rng.randrange(len(copy))
    match rng.randrange(6):
        case 0:
            del copy[place]
        case 1 if isinstance(copy, dict):
            copy[rng.choice(KEYS)] = copy.pop(place)
        case 1:
            copy.append(copy[place])
        case _:
            copy[place] = value_changed(rng, copy[place])
    return copy


def to_json(value: Any) -> bytes:
    """With what Python's writer refuses: brackets without end."""
    text = json.dumps(value, default=lambda nested: "<nested>")
    return text.replace('"<nested>"', "[" * DEPTH + "]" * DEPTH).encode("utf-8", "surrogatepass")


def bytes_changed(rng: Random, data: bytes) -> bytes:
    """Flips some bits, cuts the file off, or inserts or removes some bytes."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        place, size = rng.randrange(len(data) + 1), rng.choice((1, 4, 100))
        match rng.randrange(5):
            case 0:
                data = data[:place]
            case 1:
                data = data[:place] + rng.randbytes(size) + data[place:]
            case 2:
                data = data[:place] + data[place + size :]
            case _:
                flipped = bytearray(data)
                for _ in range(rng.choice((1, 1, 2, 8, 64)) if data else 0):
                    # Headers are what comes first.
                    among = len(flipped) if rng.random() < 0.5 else min(len(flipped), 600)
                    flipped[rng.randrange(among)] ^= 1 << rng.randrange(8)
                data = bytes(flipped)
    return data


def safetensors_changed(rng: Random, data: bytes) -> bytes:
    """The header of the file, the record in its metadata, the length of the header, or the numbers themselves."""
    length = struct.unpack_from("<Q", data)[0]
    header, body, size = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :]), None
    match rng.randrange(7):
        case 0:
            header = value_changed(rng, header)
        case 1 | 2:
            text = to_json(value_changed(rng, json.loads(header["__metadata__"]["ngpt"])))
            header["__metadata__"]["ngpt"] = text.decode("utf-8", "replace")
        case 3:
            place = rng.randrange(len(body) // 4) * 4
            body[place : place + 4] = struct.pack("<f", rng.choice((float("nan"), float("inf"), float("-inf"))))
        case 4:
            del body[rng.randrange(len(body) + 1) :]
        case 5:
            a, b = rng.sample([name for name in header if name != "__metadata__"], 2)
            header[a], header[b] = header[b], header[a]
        case 6:
            size = rng.choice((0, 2**63, 2**27, length - 1, length + 5))
    text = to_json(header)
    data = struct.pack("<Q", len(text) if size is None else size) + text + bytes(body)
    return bytes_changed(rng, data) if rng.random() < 0.1 else data
