"""Twins to read before the integrators that do it fast."""
