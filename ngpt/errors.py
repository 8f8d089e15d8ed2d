"""The one exception that users of ngpt meet, its subclass for wrong calls, and interrupts that other libraries hide."""

from collections.abc import Iterable

LONGEST = 1000


class NgptError(ValueError):
    """A problem the user can act on.

    The message is one line that names the file, the layer and the number that is wrong, and says what to do about it.
    Text from a broken file, with line breaks or a megabyte long, is shortened to one line. The library only raises it;
    the command line prints it and turns it into an exit status.
    """

    def __init__(self, message: str):
        line = " ".join(message.splitlines())
        half = LONGEST // 2 - 3
        super().__init__(line if len(line) <= LONGEST else f"{line[:half]} ... {line[-half:]}")


class WrongUse(NgptError):
    """A request that makes no sense, whatever the files hold: an unknown option, a wrong value, or two options that
    exclude each other.

    The command line ends with status 2 for it, and with 1 for any other ``NgptError``.
    """


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The question "did you mean '...'? " if an unknown ``word`` is near one of the ``known`` names, else "".

    Messages put it before the list of the known names.
    """
    from difflib import get_close_matches  # only for those who mistype

    near = get_close_matches(word.lower(), names := {name.lower(): name for name in known}, 1)
    return f"did you mean '{names[near[0]]}'? " if near else ""


class Interrupted(KeyboardInterrupt):
    """The exception that Ctrl-C and SIGTERM raise in a command.

    Once a plain KeyboardInterrupt has passed through code compiled from a string, such as that of dataclasses and named
    tuples, Python 3.11 ends itself by SIGINT, whatever exit status it is given.
    """


def stop_if_interrupted(error: BaseException) -> None:
    """Raises KeyboardInterrupt if ``error`` was caused by one, as after Ctrl-C in a library that wraps exceptions.

    Dr.Jit's loops and recordings turn a KeyboardInterrupt into a RuntimeError that holds its cause. Mitsuba's plugins
    turn it into a RuntimeError with only a text.
    """
    cause: BaseException | None = error
    while cause is not None:
        told = str(cause).rstrip().endswith(("\nKeyboardInterrupt:", "\nInterrupted:"))
        if told or isinstance(cause, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        cause = cause.__cause__ or cause.__context__
