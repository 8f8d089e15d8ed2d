"""Networks: their inputs, shapes and weights, run by ONNX Runtime and PyTorch. ``import ngpt`` imports no torch."""
