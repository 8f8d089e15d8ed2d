"""The parts of an ONNX file around the network. Each module repeats the library's module of the same name as a
graph.
"""
