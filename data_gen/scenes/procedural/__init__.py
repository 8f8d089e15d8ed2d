"""Scenes made from a seed: rooms, things, materials, textures."""
