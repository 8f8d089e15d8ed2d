"""The one exception that users of ngpt meet."""


class NgptError(ValueError):
    """A problem the user can act on.

    The message is one line that names the file, the layer and the number that is wrong, and says what to do about it.
    The library only raises it; the command line prints it and turns it into an exit status.
    """
