"""Metrics and perceptual distances between an image and its reference."""
