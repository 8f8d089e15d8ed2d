"""Scenes: built in, and made from a seed."""
