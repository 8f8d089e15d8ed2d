"""Graphs for the parts of an ONNX file around the network. Each module repeats the module that its docstring names."""
