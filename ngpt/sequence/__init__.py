"""Shots: frame after frame, with what the frames before it know."""
