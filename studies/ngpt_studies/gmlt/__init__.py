"""Gradient-domain Metropolis light transport: chains of paths of ``gpt``, which stay where light was found."""
