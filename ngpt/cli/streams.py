"""``-`` as the name of a file: standard input, or standard output."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ngpt.errors import NgptError

STREAM = "-"


@contextmanager
def as_files(stacks: list[str], output: str | None) -> Iterator[tuple[list[str], str | None]]:
    """The names of inputs and output with files in the place of ``-``.

    What comes by standard input is there when the block begins. What the block has written goes to standard output when
    it ends well. OpenEXR files are read and written here and there, so neither can do without a file.

    Raises NgptError for ``-`` beside other inputs, without an output, and for images that would go to a terminal.
    """
    if STREAM not in stacks and output != STREAM:
        yield stacks, output
        return
    if len(stacks) > 1:
        raise NgptError(f"'{STREAM}' is one stack, and {len(stacks)} are given; denoise them one by one")
    if output is None:
        raise NgptError(
            "standard input has no name to go by: name the result, -o FILE.exr, or -o - for standard output"
        )
    if output == STREAM and sys.stdout.isatty():
        raise NgptError("standard output is a terminal: send it into a file or a program, or name a file with -o")
    with tempfile.TemporaryDirectory(prefix="ngpt-") as folder:
        source, target = (Path(folder) / f"standard-{name}.exr" for name in ("input", "output"))
        if stacks == [STREAM]:
            with source.open("wb") as file:
                shutil.copyfileobj(sys.stdin.buffer, file)
        yield (
            [str(source)] if stacks == [STREAM] else stacks,
            str(target) if output == STREAM else output,
        )
        if output == STREAM and target.exists():
            with target.open("rb") as file:
                shutil.copyfileobj(file, sys.stdout.buffer)
            sys.stdout.buffer.flush()
