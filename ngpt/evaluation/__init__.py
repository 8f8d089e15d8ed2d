"""Compares samplers and methods on the same scenes after the same time."""
