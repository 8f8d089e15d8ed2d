"""``ngpt denoise --temporal -m wcv`` where frames have ``dt``: results by the frames before and after."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.errors import NgptError
from ngpt.measure.metrics import compare
from ngpt.sequence.windows import reconstruct_shot
from ngpt.stack import GradientStack


def windowed(
    pairs: Sequence[tuple[Path, Path]],
    read: Callable[[tuple[Path, Path]], Any],
    write: Callable[[Any], dict],
    reference: np.ndarray | None,
) -> Iterator[dict | NgptError]:
    """What there is to report of each pair, in order: files that cannot be read are cuts, and reported.

    ``read`` and ``write`` are those of ``ngpt.cli.denoise``, of frames; what is ``there`` is read and not written.
    """
    frames: dict[int, Any] = {}
    told: dict[int, dict | NgptError] = {}

    def stacks() -> Iterator[GradientStack | None]:
        for number, pair in enumerate(pairs):
            try:
                frames[number] = read(pair)
            except NgptError as error:
                told[number] = error
                yield None
                continue
            yield frames[number].stack

    done = 0
    for number, _, result in reconstruct_shot(stacks(), lambda number: not frames[number].there):
        while done < number:
            yield told[done] if done in told else write(frames.pop(done))
            done += 1
        metrics = compare(result.image, reference) if reference is not None else None
        yield write(frames.pop(number)._replace(result=result, metrics=metrics))
        done = number + 1
    while done < len(pairs):
        yield told[done] if done in told else write(frames.pop(done))
        done += 1
