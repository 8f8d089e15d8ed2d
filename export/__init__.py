"""export: reconstructions as ONNX files that any renderer can run."""
