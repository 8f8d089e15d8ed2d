"""What surrounds a network in its ONNX file: each file does what the module of that name does in the library."""
