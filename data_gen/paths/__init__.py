"""What paths are made of: camera samples, random streams, vertices, lights, shifts, features."""
