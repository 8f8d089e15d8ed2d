"""Gradient-domain Metropolis light transport: Markov chains of ``gpt``'s paths, which stay where light was found."""
