"""Reads, computes and writes items at the same time, so that computing does not wait for a disk or a decoder."""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, TypeVar

from ngpt.errors import NgptError, WrongUse

Item = TypeVar("Item")
Read = TypeVar("Read")
Made = TypeVar("Made")
Written = TypeVar("Written")


def overlapped(
    items: Sequence[Item],
    read: Callable[[Item], Read],
    compute: Callable[[Read], Made],
    write: Callable[[Made], Written],
) -> Generator[Written | NgptError, None, None]:
    """Yields ``write(compute(read(item)))`` for each item in order, or the NgptError of an item that fails.

    ``read`` is one item ahead and ``write`` one item behind, each in its own thread; ``compute`` runs in the caller's
    thread. At most three items are held at once. WrongUse, which concerns all items, and any other error are raised in
    the turn of their item. If an interrupt or ``close()`` ends the work early, the threads finish their current items.
    A single item needs no threads. Raises MemoryError if the threads cannot be started.
    """
    if len(items) == 1:
        yield _outcome(_attempt(write, _attempt(compute, _attempt(read, items[0]))))
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
                yield _outcome(going.get())
            going = _begun(writer, write, value)
            del value  # so that it is freed once it is written
        if going:
            yield _outcome(going.get())


def _begun(thread: ThreadPoolExecutor, stage: Callable[[Any], Any], value: Any) -> SimpleQueue:
    """Begins a stage in a thread. Its result or error will be in the returned queue.

    A future is not used. If an interrupt comes during a wait for a future, the future's lock may stay held, and the
    thread waits forever.
    """
    outcome: SimpleQueue = SimpleQueue()
    thread.submit(lambda: outcome.put(_attempt(stage, value)))
    return outcome


def _attempt(stage: Callable[[Any], Any], value: Any) -> Any:
    """The result of a stage, or its error. An error of an earlier stage is returned as it is."""
    if isinstance(value, Exception):
        return value
    try:
        return stage(value)
    except Exception as error:
        return error


def _outcome(outcome: Any) -> Any:
    """The outcome of an item. Raises an error that is not the item's own."""
    if isinstance(outcome, Exception) and (isinstance(outcome, WrongUse) or not isinstance(outcome, NgptError)):
        raise outcome
    return outcome
