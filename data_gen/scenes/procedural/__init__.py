"""Scenes made from a seed: rooms, things, materials and textures."""
