"""What leaves a machine that is given back, and what goes there: files within limits of size and number.

    python -m scripts.gpu.parcel divide DATASET... --most 32 -o parts     training sets of at most 32 MiB: parts/00, ...
    python -m scripts.gpu.parcel open FOLDER WORK                         what a window left, into its working folder

A window's parcel is one archive in pieces, `kept.000`, `kept.001`, ... Checkpoints in it are in 16 bits, which halves
them: what goes on from there is not the same to the last bit.
"""

import argparse
import io
import json
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from ngpt.errors import NgptError
from ngpt.system.files import atomic_output
from ngpt.system.writing import write_json
from ngpt.training.dataset import MANIFEST, read_manifest

PIECE = 15  # MiB of one file
MOST = 60  # MiB of all files
CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"


def kept(work: Path) -> Iterator[Path]:
    """The files of a working folder by their worth: records, pictures, checkpoints, then shards.

    Weights are in the checkpoints. Of the pictures of a run the last one is enough.
    """
    for pattern in ("checks/*.json", "windows/*.json", "logs/*.txt", "runs/*/settings.json", "runs/*/log.jsonl"):
        yield from sorted(work.glob(pattern))
    for run in sorted(work.glob("runs/*")):
        yield from sorted(run.glob("validation-*.png"))[-1:]
    yield from sorted(work.glob(f"runs/*/{CHECKPOINT}"))
    yield from work.glob(f"data/{MANIFEST}")
    yield from sorted(work.glob("data/shards/[!.]*.safetensors"))


def pack(work: Path, out: Path, piece: float = PIECE, most: float = MOST) -> list[str]:
    """Writes the parcel of ``work`` into ``out``; returns the names of what did not fit in, ``most`` MiB."""
    for old in out.glob("kept.*"):
        old.unlink()
    data, left_out, room = io.BytesIO(), [], most * 2**20 - 2**16
    with tarfile.open(fileobj=data, mode="w") as archive:
        for path in kept(work):
            content = slim(path) if path.name == CHECKPOINT else path.read_bytes()
            name = path.relative_to(work).as_posix()
            if data.tell() + len(content) + 2048 > room:
                left_out.append(name)
                continue
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    size = int(piece * 2**20)
    view = data.getbuffer()
    for number, first in enumerate(range(0, len(view), size)):
        with atomic_output(out / f"kept.{number:03d}", overwrite=True) as path:
            path.write_bytes(view[first : first + size])
    return left_out


def unpack(folder: Path, work: Path) -> bool:
    """Opens the parcel in ``folder`` into ``work``, with weights beside its checkpoints; False if there is none.

    Raises NgptError for a parcel that lacks a piece, or is damaged.
    """
    pieces = sorted(folder.glob("kept.[0-9][0-9][0-9]"))
    if not pieces:
        return False
    if [path.name for path in pieces] != [f"kept.{i:03d}" for i in range(len(pieces))]:
        raise NgptError(f"{folder}: a piece of the parcel is missing; it has {', '.join(p.name for p in pieces)}")
    data = io.BytesIO(b"".join(path.read_bytes() for path in pieces))
    work.mkdir(parents=True, exist_ok=True)
    try:
        with tarfile.open(fileobj=data) as archive:
            archive.extractall(work, filter="data")
    except tarfile.TarError as error:
        raise NgptError(f"{folder}: the parcel cannot be opened: {error}; is its last piece missing?") from error
    if (work / "data" / MANIFEST).is_file():
        manifest = read_manifest(work / "data")
        there = [entry for entry in manifest["shards"] if (work / "data" / entry["file"]).is_file()]
        write_json(work / "data" / MANIFEST, manifest | {"shards": there})
    for checkpoint in work.glob(f"runs/*/{CHECKPOINT}"):
        restore(checkpoint)
    return True


def slim(checkpoint: Path) -> bytes:
    """The checkpoint in 16 bits: weights in half floats, Adam's moments, which may be small, in bfloat16."""
    import torch
    from safetensors.torch import save

    from ngpt.network.weights import FORMAT, read_tensors

    tensors, header = read_tensors(checkpoint)
    kinds = {name: torch.bfloat16 if name.startswith("adam") else torch.float16 for name in tensors}
    small = {name: tensor.to(kinds[name]) for name, tensor in tensors.items()}
    return save(small, metadata={"ngpt": json.dumps({"format": FORMAT} | header)})


def restore(checkpoint: Path) -> None:
    """The checkpoint in 32 bits again, and the weights for inference beside it."""
    from ngpt.network.model import Reconstructor
    from ngpt.network.weights import fill, read_tensors, save_weights, write_tensors
    from ngpt.training.settings import from_dict

    tensors, header = read_tensors(checkpoint)
    tensors = {name: tensor.float() for name, tensor in tensors.items()}
    write_tensors(checkpoint, tensors, header, overwrite=True)
    settings = from_dict(header["settings"], str(checkpoint))
    model = Reconstructor(settings.model)
    part = "average/" if settings.optimizer.ema else "model/"
    fill(model, {n.removeprefix(part): t for n, t in tensors.items() if n.startswith(part)}, str(checkpoint))
    provenance = {"step": header["step"], "hours": round(header["seconds"] / 3600, 3)}
    save_weights(checkpoint.with_name(WEIGHTS), model, provenance, overwrite=True)


def divide(datasets: Sequence[Path], out: Path, most: float) -> list[Path]:
    """Training sets ``out``/00, 01, ... of at most ``most`` MiB with all shards of ``datasets``, each of all of them.

    Shards of one name, of sets with another seed, do not meet: each set is divided by itself. Raises NgptError for a
    shard that is larger than that.
    """
    made: list[Path] = []
    for dataset in datasets:
        manifest = read_manifest(dataset)
        entries = [entry for entry in manifest["shards"] if entry["crops"]]
        total = sum(entry["bytes"] for entry in entries)
        if entries and max(entry["bytes"] for entry in entries) > most * 2**20:
            raise NgptError(f"{dataset}: has a shard of more than {most:g} MiB; allow more (--most)")
        groups: list[list[dict]] = [[] for _ in range(max(1, -(-total // int(most * 2**20))))]
        while not _dealt(entries, groups, most):
            groups.append([])
        for group in groups:
            folder = out / f"{len(made):02d}"
            (folder / "shards").mkdir(parents=True)
            for entry in group:
                (folder / entry["file"]).write_bytes((dataset / entry["file"]).read_bytes())
            write_json(folder / MANIFEST, manifest | {"shards": group})
            made.append(folder)
    return made


def _dealt(entries: list[dict], groups: list[list[dict]], most: float) -> bool:
    """Deals entries round to groups, so that each has some of all scenes; whether all of them are small enough."""
    for number, group in enumerate(groups):
        group[:] = entries[number :: len(groups)]
    return all(sum(entry["bytes"] for entry in group) <= most * 2**20 for group in groups)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    dividing = verbs.add_parser("divide")
    dividing.add_argument("datasets", type=Path, nargs="+")
    dividing.add_argument("--most", type=float, default=32.0, metavar="MIB")
    dividing.add_argument("-o", "--output", type=Path, required=True)
    opening = verbs.add_parser("open")
    opening.add_argument("folder", type=Path)
    opening.add_argument("work", type=Path)
    args = parser.parse_args()
    try:
        if args.verb == "divide":
            print(*divide(args.datasets, args.output, args.most), sep="\n")
        elif not unpack(args.folder, args.work):
            raise NgptError(f"{args.folder}: holds no parcel (kept.000, ...)")
    except NgptError as error:
        raise SystemExit(f"parcel: {error}") from error


if __name__ == "__main__":
    main()
