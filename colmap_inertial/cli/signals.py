"""Ctrl-C and a request to end: answered at once, however deep in compiled code the work is; the second ends at once."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from types import FrameType

#: What a shell gives the end by a signal: 128 and the signal's number.
INTERRUPTED, TERMINATED = 130, 143


class Terminated(KeyboardInterrupt):
    """Somebody asked this process to end, as ``kill`` and schedulers do."""


@contextlib.contextmanager
def answering_signals() -> Iterator[None]:
    """Within it, the first Ctrl-C is answered at once and ends the work where it can be ended; the second one ends all.

    Python's own handlers wait until compiled code returns, which may be minutes. So a thread hears of signals as well.
    Outside of the main thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    here, there = socket.socketpair()
    there.setblocking(False)
    old_fd = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)
    old_term = signal.signal(signal.SIGTERM, _terminate)
    thread = threading.Thread(target=_answer, args=(here,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, old_term)
        signal.set_wakeup_fd(old_fd)
        there.close()
        thread.join()
        here.close()


def _terminate(_number: int, _frame: FrameType | None) -> None:
    raise Terminated


def _answer(signals: socket.socket) -> None:
    """Say that a signal has come; end at the second one, without waiting for anybody."""
    came = 0
    while received := signals.recv(16):
        for number in received:
            if number not in (signal.SIGINT, signal.SIGTERM):
                continue
            came += 1
            if came == 1:
                print(
                    "\nstopping, which may take some seconds (Ctrl-C again ends at once)", file=sys.stderr, flush=True
                )
            else:
                if sys.stderr.isatty():
                    print("\033[?25h", end="", file=sys.stderr, flush=True)  # the cursor, which bars hide
                os._exit(INTERRUPTED if number == signal.SIGINT else TERMINATED)
