"""After ``ngpt.repair``, without its neighbours: what is not finite counts as 0."""

from ngpt.export.builder import Value, op


def finite(x: Value) -> Value:
    """Where values are: what is not finite is not 0 less than itself."""
    return op.Equal(x - x, 0.0)


def clean(x: Value) -> Value:
    """The values, 0 where they are not finite."""
    return op.Where(finite(x), x, 0.0)
