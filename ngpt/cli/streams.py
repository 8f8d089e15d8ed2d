"""The name ``-`` for standard input and standard output."""

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ngpt.errors import NgptError, WrongUse
from ngpt.system.text import called

STREAM = "-"


@contextmanager
def standard_input(names: Sequence[str]) -> Iterator[list[str]]:
    """Yields the names, with ``-`` replaced by the name of a file with the contents of standard input.

    Messages call this file "standard input". Raises WrongUse if ``-`` occurs twice.
    """
    if STREAM not in names:
        yield list(names)
        return
    if names.count(STREAM) > 1:
        raise WrongUse(f"'{STREAM}' is one image, and is given {names.count(STREAM)} times; name files for the others")
    with tempfile.TemporaryDirectory(prefix="ngpt-") as folder:
        source = Path(folder) / "standard-input"
        with source.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        with called(str(source), "standard input"):
            yield [str(source) if name == STREAM else name for name in names]


@contextmanager
def as_files(stacks: list[str], output: str | None) -> Iterator[tuple[list[str], str | None]]:
    """Yields the names of inputs and output, with ``-`` replaced by the names of files, since OpenEXR needs files.

    Standard input is read before the block. After the block, the output file is copied to standard output. Raises
    NgptError for ``-`` beside other inputs or without an output, and for an image that would go to a terminal.
    """
    if STREAM in stacks and len(stacks) > 1:
        raise NgptError(f"'{STREAM}' is one stack, and {len(stacks)} are given; denoise them one by one")
    if output == STREAM and len(stacks) > 1:
        raise NgptError(f"'{STREAM}' is one result, and {len(stacks)} stacks are given; denoise them one by one")
    if stacks == [STREAM] and output is None:
        raise NgptError("standard input has no name: name the result, -o FILE.exr, or write to standard output, -o -")
    if output == STREAM and sys.stdout.isatty():
        raise NgptError("standard output is a terminal: send it into a file or a program, or name a file with -o")
    with standard_input(stacks) as inputs:
        if output != STREAM:
            yield inputs, output
            return
        with tempfile.TemporaryDirectory(prefix="ngpt-") as folder:
            target = Path(folder) / "standard-output.exr"
            try:
                with called(str(target), "standard output"):
                    yield inputs, str(target)
            finally:
                # This is done after a failed render too, which has written the samples that it finished.
                if target.exists():
                    with target.open("rb") as file:
                        shutil.copyfileobj(file, sys.stdout.buffer)
                    sys.stdout.buffer.flush()
