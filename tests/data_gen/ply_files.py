"""Squares as PLY files, for tests of scene files."""

FACES = "3 0 1 2\n3 0 2 3\n"


def square(corners, normals=()):
    """The text of a PLY file with one square of two triangles; ``normals`` are those of its corners, if it has any."""
    names = ["x", "y", "z", *(("nx", "ny", "nz") if normals else ())]
    properties = "".join(f"property float {name}\n" for name in names)
    rows = [(*p, *n) for p, n in zip(corners, normals, strict=True)] if normals else corners
    vertices = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    return (
        f"ply\nformat ascii 1.0\nelement vertex 4\n{properties}element face 2\n"
        f"property list uchar int vertex_indices\nend_header\n{vertices}{FACES}"
    )
