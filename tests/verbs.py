"""The real parsers of the verbs, for command lines that pages and scripts hold."""

from functools import cache

from ngpt.cli import _filled, _Parser, all_verbs


@cache
def parser_of(verb):
    """The real parser of a verb, which refuses a line by leaving with status 2."""
    verbs = all_verbs()
    assert verb in verbs, f"ngpt {verb}"
    return _filled(_Parser(prog=f"ngpt {verb}"), verb, verbs[verb])
