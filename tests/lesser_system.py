"""Takes away from this system what others lack: a process that imports it first has no more than Windows gives.

Gone are modules, functions and signals, /proc and /dev/fd, and folders that can be opened like files. What the system's
own libraries do with paths, endings of lines and files in use stays as it is here.
"""

import contextlib
import os
import signal
import sys

MODULES = ("fcntl", "grp", "pwd", "resource", "syslog", "termios", "tty")
FUNCTIONS = (
    *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "chown", "fchmod", "fchown", "fork", "forkpty"),
    *("getegid", "geteuid", "getgid", "getpgid", "getuid", "killpg", "mkfifo", "nice", "register_at_fork"),
    *("sched_getaffinity", "sched_setaffinity", "setsid", "statvfs", "sysconf"),
)
SIGNALS = ("SIGALRM", "SIGCHLD", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGUSR1", "SIGUSR2")


def _is_missing(path: object) -> bool:
    return isinstance(path, str | bytes) and os.fsdecode(path).startswith(("/proc/", "/dev/fd"))


def _open(event: str, arguments: tuple) -> None:
    """Refuses to open what cannot be opened there."""
    if event == "open":
        path = arguments[0]
        if _is_missing(path):
            raise FileNotFoundError(2, "No such file or directory", path)
        if isinstance(path, str | bytes) and os.path.isdir(path):
            raise PermissionError(13, "Permission denied", path)


def _stat(path, *arguments, _whole=os.stat, **named):
    if not isinstance(path, int) and _is_missing(os.fspath(path)):
        raise FileNotFoundError(2, "No such file or directory", path)
    return _whole(path, *arguments, **named)


for _name in MODULES:
    sys.modules[_name] = None  # type: ignore[assignment]
for _place, _names in ((os, FUNCTIONS), (signal, SIGNALS)):
    for _name in _names:
        with contextlib.suppress(AttributeError):
            delattr(_place, _name)
os.stat = _stat
sys.addaudithook(_open)
