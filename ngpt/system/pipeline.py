"""Reads, computes and writes at the same time, so that computing never waits for a disk or a decoder."""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, TypeVar

from ngpt.errors import NgptError, WrongUse

Item = TypeVar("Item")
Read = TypeVar("Read")
Made = TypeVar("Made")
Told = TypeVar("Told")


def overlapped(
    items: Sequence[Item], read: Callable[[Item], Read], compute: Callable[[Read], Made], write: Callable[[Made], Told]
) -> Generator[Told | NgptError, None, None]:
    """Yields ``write(compute(read(item)))`` of each item, in order; for an item that fails, its NgptError.

    ``read`` is one item ahead and ``write`` one behind, each in its own thread; ``compute`` runs in the caller's.
    So at most three items are held at once. Any other error is raised when its item's turn comes, and so is WrongUse,
    which concerns all items. If an interrupt or ``close()`` ends the work early, the threads finish what they have
    begun and start nothing else. A single item needs no threads. Raises MemoryError if there is no room for two.
    """
    if len(items) == 1:
        yield _told(_attempt(write, _attempt(compute, _attempt(read, items[0]))))
        return
    with ThreadPoolExecutor(1, "read") as reader, ThreadPoolExecutor(1, "write") as writer:
        try:
            for thread in (reader, writer):
                thread.submit(int)
        except RuntimeError as error:  # Python's error if it cannot start a thread
            raise MemoryError(str(error)) from error
        coming: SimpleQueue | None = None
        going: SimpleQueue | None = None
        for i, item in enumerate(items):
            value = (coming or _begun(reader, read, item)).get()
            coming = _begun(reader, read, items[i + 1]) if i + 1 < len(items) else None
            value = _attempt(compute, value)
            if going:
                yield _told(going.get())
            going = _begun(writer, write, value)
            del value  # only the writer keeps it, so that it is freed once written
        if going:
            yield _told(going.get())


def _begun(thread: ThreadPoolExecutor, stage: Callable[[Any], Any], value: Any) -> SimpleQueue:
    """Begins a stage; its result or error will be in the queue.

    An interrupt while one waits for a future may leave its lock held, and the thread would wait for that lock for ever.
    """
    outcome: SimpleQueue = SimpleQueue()
    thread.submit(lambda: outcome.put(_attempt(stage, value)))
    return outcome


def _attempt(stage: Callable[[Any], Any], value: Any) -> Any:
    """The result of a stage, or its error; errors of earlier stages are passed through."""
    if isinstance(value, Exception):
        return value
    try:
        return stage(value)
    except Exception as error:
        return error


def _told(outcome: Any) -> Any:
    """The outcome of an item, unless it is an error that concerns all of them."""
    if isinstance(outcome, Exception) and (isinstance(outcome, WrongUse) or not isinstance(outcome, NgptError)):
        raise outcome
    return outcome
