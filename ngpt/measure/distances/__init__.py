"""Perceptual distances in PyTorch, for training and for E-LPIPS as a metric."""
