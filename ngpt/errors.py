"""The exception that ngpt raises for users, its subclass for wrong calls, and interrupts that other libraries hide."""

from collections.abc import Iterable

LONGEST = 1000


class NgptError(ValueError):
    """A problem that the user can solve.

    The message is one line that names the file, the layer and the wrong number, and says what to do. Line breaks are
    removed and long texts are shortened, because text from a broken file may be a megabyte long. The command line
    prints the message and ends with status 1.
    """

    def __init__(self, message: str):
        line = " ".join(message.splitlines())
        half = LONGEST // 2 - 3
        super().__init__(line if len(line) <= LONGEST else f"{line[:half]} ... {line[-half:]}")


class WrongUse(NgptError):
    """A request that makes no sense for any file: an unknown option, a wrong value, or options that exclude each other.

    The command line ends with status 2.
    """


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question "did you mean '...'? " if an unknown ``word`` is similar to one of the ``known`` names, else ""."""
    from difflib import get_close_matches  # only needed for typing errors

    near = get_close_matches(word.lower(), names := {name.lower(): name for name in known}, 1)
    return f"did you mean '{names[near[0]]}'? " if near else ""


class Interrupted(KeyboardInterrupt):
    """The exception that Ctrl-C and SIGTERM raise in a command.

    It is a subclass and not KeyboardInterrupt itself. If a plain KeyboardInterrupt has passed through code compiled
    from a string, such as the code of dataclasses and named tuples, Python 3.11 ends by SIGINT, with another exit
    status.
    """


def stop_if_interrupted(error: BaseException) -> None:
    """Raises KeyboardInterrupt if ``error`` comes from a KeyboardInterrupt that another library has wrapped.

    Dr.Jit's loops and recordings turn a KeyboardInterrupt into a RuntimeError with a cause. Mitsuba's plugins turn it
    into a RuntimeError whose text ends in the name of the exception.
    """
    cause: BaseException | None = error
    while cause is not None:
        by_text = str(cause).rstrip().endswith(("\nKeyboardInterrupt:", "\nInterrupted:"))
        if by_text or isinstance(cause, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        cause = cause.__cause__ or cause.__context__
