"""Fixtures that tests of studies share with those of our samplers."""

from recorded_kernels import kernels_are_recorded_once, recordings  # noqa: F401
