"""The parts of an ONNX file around the network. Each module repeats a module of the same name as a graph."""
