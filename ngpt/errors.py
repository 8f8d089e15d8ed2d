"""The one exception that users of ngpt meet."""

LONGEST = 1000


class NgptError(ValueError):
    """A problem the user can act on.

    The message is one line that names the file, the layer and the number that is wrong, and says what to do about it.
    What a broken file puts into it, line breaks or a megabyte of text, is brought down to that. The library only raises
    it; the command line prints it and turns it into an exit status.
    """

    def __init__(self, message: str):
        line = " ".join(message.splitlines())
        half = LONGEST // 2 - 3
        super().__init__(line if len(line) <= LONGEST else f"{line[:half]} ... {line[-half:]}")
