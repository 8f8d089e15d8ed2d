"""Reconstructions as ONNX files that any renderer can run."""
