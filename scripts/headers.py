"""Fetches ONNX Runtime's C++ headers, which libngpt is built with: python3 scripts/headers.py [FOLDER]

The headers come from Debian 13's package libonnxruntime-dev, which is checked against its SHA-256, and go to
FOLDER/include. The default FOLDER is build/onnxruntime, where the tests look. The library is not included:
`pip install onnxruntime` has one.
"""

import hashlib
import io
import sys
import tarfile
import urllib.request
from pathlib import Path

PACKAGE = "https://deb.debian.org/debian/pool/main/o/onnxruntime/libonnxruntime-dev_1.21.0+dfsg-1_amd64.deb"
SHA256 = "14f7d959d5deacbcf1504830d4189f91fc67382b399ed9ae9d3aa9c4050ced08"
PREFIX = "./usr/include/onnxruntime/"


def member(archive: bytes, name: str) -> bytes:
    """A file in an archive of `ar`, which a .deb is."""
    at = len(b"!<arch>\n")
    while at < len(archive):
        found, size = archive[at : at + 16].decode().strip(" /"), int(archive[at + 48 : at + 58])
        if found == name:
            return archive[at + 60 : at + 60 + size]
        at += 60 + size + size % 2
    raise SystemExit(f"{PACKAGE}: has no {name}")


def main(folder: Path) -> None:
    with urllib.request.urlopen(PACKAGE, timeout=60) as answer:
        package = answer.read()
    if hashlib.sha256(package).hexdigest() != SHA256:
        raise SystemExit(f"{PACKAGE}: has another SHA-256 than the one it was tested with")
    with tarfile.open(fileobj=io.BytesIO(member(package, "data.tar.xz"))) as files:
        for item in files:
            content = files.extractfile(item) if item.isfile() and item.name.startswith(PREFIX) else None
            if content:
                path = folder / "include" / item.name.removeprefix(PREFIX)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content.read())
    print(folder)


if __name__ == "__main__":
    root = Path(__file__).parents[1] / "build" / "onnxruntime"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else root)
