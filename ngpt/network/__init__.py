"""The neural reconstruction: network, training and inference in PyTorch. ``import ngpt`` imports none of it."""
