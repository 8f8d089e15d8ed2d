"""What a program touched, by strace: the files it made or wrote, and the addresses it spoke to beyond this machine."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

CALLS = "%network,open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,link,linkat,symlink,symlinkat"
# Calls that make or change the file that they name last.
_MAKES = re.compile(r"\b(?:creat|mkdir|mkdirat|rename|renameat|renameat2|link|linkat|symlink|symlinkat)\(")
_WRITES = re.compile(r"\bopen(?:at)?\(.*\bO_(?:WRONLY|RDWR|CREAT)\b")
# IPv4 and IPv6, for speech of any kind.
_ADDRESS = re.compile(r'(?:inet_addr\(|inet_pton\(AF_INET6, )"([^"]+)"')
_HERE = re.compile(r"127\..*|::1|::ffff:127\..*")


def traced(command, folder: Path, environment: dict[str, str]) -> list[str]:
    """The lines of strace for a command and its children. Skips where there is no strace, or it may not trace."""
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed")
    record = folder / "strace.txt"
    done = subprocess.run(
        [strace, "-f", "-qq", "-s", "4096", "-e", f"trace={CALLS}", "-o", record, *map(str, command)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    if "PTRACE" in done.stderr or "ptrace" in done.stderr:
        pytest.skip(f"strace may not trace here: {done.stderr[:200]}")
    assert done.returncode == 0, done.stderr[-2000:]
    return record.read_text(errors="replace").splitlines()


def written(lines: list[str], folder: Path) -> set[str]:
    """The absolute names of files and folders that were made, or opened to be written."""
    found = set()
    for line in lines:
        if re.search(r"= -1 E", line) or not (_MAKES.search(line) or _WRITES.search(line)):
            continue
        named = re.findall(r'"((?:[^"\\]|\\.)*)"', line)
        found.add(os.path.normpath(folder / named[-1]))
    return found


def spoken_to(lines: list[str]) -> set[str]:
    """The addresses beyond this machine that were connected or sent to."""
    calls = [line for line in lines if re.search(r"\b(?:connect|sendto|sendmsg|sendmmsg)\(", line)]
    return {address for line in calls for address in _ADDRESS.findall(line) if not _HERE.fullmatch(address)}
