"""Shots: frames that are reconstructed with the help of neighbouring frames."""
