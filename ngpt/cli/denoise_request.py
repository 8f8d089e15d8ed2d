"""The request of ``ngpt denoise``: a frozen record, made once from the command line and passed down whole."""

import argparse
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ngpt.cli import arguments
from ngpt.cli.reference import ReferenceImage
from ngpt.errors import WrongUse
from ngpt.io.framenames import named, number_of, varies
from ngpt.io.frames import RESULT_SUFFIX
from ngpt.methods import check_request
from ngpt.result_file import Look, check_image


@dataclass(frozen=True)
class DenoiseRequest:
    """The files to denoise, how to denoise them, and how to write the results.

    Most fields are options of ``ngpt denoise``, whose help explains them. The other fields are:

    ``pairs``      the file of each stack, and the file for its result
    ``options``    the options of the method, which may be texts
    ``layer``      names of layers in the files, by the names of the contract, as for ``ngpt.read``
    ``files``      separate files of layers, by the names of the contract; only for a single stack
    ``groups``     patterns of the light groups that are denoised too; () for the groups of known renderers; None for no
                   groups
    ``reference``  the image that results are compared with
    ``look``       how pictures show light
    """

    stacks: list[str]
    pairs: list[tuple[Path, Path]]
    method: str
    options: Mapping[str, Any]
    layer: Mapping[str, str]
    files: Mapping[str, str]
    view: str | None
    untrusted: bool
    wrap: bool
    reduce: int
    error: bool
    halves: list[str] | None
    groups: list[str] | None
    temporal: bool
    reference: ReferenceImage | None
    into: str | None
    look: Look
    force: bool
    skip_existing: bool


def request_of(args: argparse.Namespace) -> DenoiseRequest:
    """The request of a command line. Raises an error if it fits no stack, or if a result could not be written."""
    pairs, files = output_paths(arguments.stack_files(args.stacks), args.output), arguments.given_files(args)
    if len(pairs) > 1 and (files or args.halves):
        of_one = f"--{next(iter(files))} belongs" if files else "--halves belong"
        raise WrongUse(f"{of_one} to one stack, and {len(pairs)} are given; denoise them one by one")
    groups = args.group if args.groups or args.group else None
    makes_layers = {"--error": args.error or args.halves, "--groups": groups is not None, "--into": args.into}
    for option in ("--error", "--groups") if args.temporal else ():
        if makes_layers[option]:
            raise WrongUse(f"--temporal and {option} cannot be combined; leave one out")
    options = {name: getattr(args, name) for name in ("alpha", "weights", "device", "memory")}
    options = {name: value for name, value in options.items() if value is not None} | dict(args.option)
    check_request(args.method, options)
    reference = ReferenceImage.read(args.ref, args.untrusted) if args.ref else None
    for _, target in pairs:
        if target.suffix.lower() != ".exr":
            check_image(target, args.transform)
            for option in (option for option, given in makes_layers.items() if given):
                raise WrongUse(f"{option} makes layers, and {target} can have none; let it end in .exr")
            if args.skip_existing:
                raise WrongUse(f"--skip-existing checks only OpenEXR files; leave it out for {target}")
        arguments.output_file(target, args)
    given = vars(args) | {"pairs": pairs, "files": files, "options": options, "groups": groups, "reference": reference}
    given |= {"layer": dict(args.layer), "error": bool(makes_layers["--error"])}
    given |= {"look": Look(args.transform, args.exposure)}
    return DenoiseRequest(**{field.name: given[field.name] for field in fields(DenoiseRequest)})


def output_paths(sources: list[Path], output: str | None) -> list[tuple[Path, Path]]:
    """Each source with the file for its result, as ``--output`` says. Raises WrongUse if two results had one file."""
    if output is None:
        targets = [path.with_name(f"{path.stem}{RESULT_SUFFIX}.exr") for path in sources]
    elif varies(output):
        targets = [Path(named(output, number_of(path, output))) for path in sources]
    elif len(sources) == 1 and Path(output).suffix and not Path(output).is_dir() and not output.endswith(("/", os.sep)):
        targets = [Path(output)]
    else:
        folder = Path(output)
        named_file = folder.suffix.lower() == ".exr" and not output.endswith(("/", os.sep))
        if not folder.is_dir() and (folder.exists() or named_file):
            kind = "is a file" if folder.exists() else "is the name of a file"
            raise WrongUse(f"{folder}: {kind}; the results of {len(sources)} stacks need a folder")
        targets = [folder / (path.name if path.suffix.lower() == ".exr" else f"{path.stem}.exr") for path in sources]
    repeated = next((t for i, t in enumerate(targets) if t in targets[:i]), None)
    if repeated:
        raise WrongUse(f"{repeated}: would be the result of two stacks of that name; denoise them one by one")
    return list(zip(sources, targets, strict=True))
