"""Worker processes that do not outlive the process they work for."""

import os
import signal
import threading
from multiprocessing import parent_process


def end_with_parent(interruptible: bool = True) -> None:
    """To be called in a worker of multiprocessing: it ends when its parent does, even if that is killed.

    Linux' PR_SET_PDEATHSIG would take the end of the thread that started the worker for the end of the process. Ctrl-C,
    which all processes of a terminal receive, ends a worker silently, unless it is not ``interruptible``.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL if interruptible else signal.SIG_IGN)
    threading.Thread(target=_wait, daemon=True).start()


def _wait() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
