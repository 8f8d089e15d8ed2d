"""Gradient-domain bidirectional path tracing: ``bdpt`` and, for each of its paths, four in neighbouring pixels."""
