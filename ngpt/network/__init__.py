"""The neural reconstruction: network, training and inference in PyTorch. Nothing here is imported by ``import ngpt``."""
