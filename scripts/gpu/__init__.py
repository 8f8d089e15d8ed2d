"""A window on one GPU: checks of everything that runs on it, crops, training, and results small enough to take home."""
