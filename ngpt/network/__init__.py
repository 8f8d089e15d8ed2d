"""What runs a network: inputs, shape, weights, in ONNX Runtime and in PyTorch. ``import ngpt`` imports no torch."""
