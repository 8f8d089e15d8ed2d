"""Shots: scenes over time, cameras along paths, and motion vectors to the previous frame."""
