"""The parts of paths: camera samples, random streams, vertices, lights, shifts, features."""
