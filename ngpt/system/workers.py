"""Ends worker processes with their parent process."""

import os
import signal
import threading
from multiprocessing import parent_process


def end_with_parent(interruptible: bool = True) -> None:
    """Ends the calling worker of multiprocessing when its parent ends, even if the parent is killed.

    Linux's PR_SET_PDEATHSIG is not used, because it ends the worker when the thread that started the worker ends.
    Ctrl-C, which all processes of a terminal receive, ends an ``interruptible`` worker silently. Other workers ignore
    Ctrl-C.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL if interruptible else signal.SIG_IGN)
    threading.Thread(target=_wait, daemon=True).start()


def _wait() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
