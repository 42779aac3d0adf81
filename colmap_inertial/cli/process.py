"""The process that runs a command: Ctrl-C and a request to end; limits of memory and of open files.

The first signal is answered at once, however deep in compiled code the work is; the second ends the process. Limits are
checked before the work: libraries that are out of memory or of files (OpenBLAS, COLMAP's threads, the loader) end the
process without a message.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from types import FrameType

from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact

#: What a shell gives the end by a signal: 128 and the signal's number.
INTERRUPTED, TERMINATED = 130, 143


class Terminated(KeyboardInterrupt):
    """Somebody asked this process to end, as ``kill`` and schedulers do."""


@contextlib.contextmanager
def answering_signals() -> Iterator[None]:
    """Answer Ctrl-C: the first one ends the work where it can stop cleanly, the second one at once.

    Python's own handlers wait until compiled code returns, which may be minutes. So a thread hears of signals as well.
    Outside of the main thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    import pycolmap  # noqa: F401 (loading it replaces the handler of SIGTERM by one that prints a stack)

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
                line = "\r\033[2K" if sys.stderr.isatty() else "\n"  # in place of a bar
                again = "Ctrl-C again" if number == signal.SIGINT else "a second signal"
                print(
                    f"{line}stopping, which may take some seconds ({again} ends at once)", file=sys.stderr, flush=True
                )
            else:
                if sys.stderr.isatty():
                    print("\033[?25h", end="", file=sys.stderr, flush=True)  # the cursor, which bars hide
                os._exit(INTERRUPTED if number == signal.SIGINT else TERMINATED)


#: Address space to begin with, and for each thread: its stack, and what the allocator keeps for it. A reconstruction of
#: small images takes 1.3 GB on two processors.
LEAST_BYTES, THREAD_BYTES = 2 << 30, 128 << 20
#: Arguments are read with numpy. With less than this, and as much for each thread, it ends in OpenBLAS's words.
LOADING_BYTES = 256 << 20
#: A reconstruction has 9 open at a time, a batch some for each process; systems allow 256 or more.
LEAST_FILES = 64


def require_limits(*, to_load: bool = False) -> None:
    """Refuse to begin with less than any command takes.

    Parameters
    ----------
    to_load
        Only where it is less than reading the arguments takes.

    Raises
    ------
    InertialError
        That says which limit, and how to raise it.
    """
    try:
        import resource
    except ImportError:  # Windows has none
        return
    # before 3.12.8, Python cuts the bytecode that it keeps off at the largest file, and can never load it again
    if resource.getrlimit(resource.RLIMIT_FSIZE)[0] != resource.RLIM_INFINITY:
        sys.dont_write_bytecode = True
    from colmap_inertial.core.threads import usable_processors

    least = LEAST_BYTES + THREAD_BYTES * usable_processors()
    loaded = LOADING_BYTES + THREAD_BYTES * usable_processors()
    space, files = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_NOFILE))
    if to_load and (space == resource.RLIM_INFINITY or space >= loaded):
        return
    if space != resource.RLIM_INFINITY and space < least:
        raise InertialError(Fact("too-little-memory-allowed", allowed_bytes=space, needed_bytes=least))
    if files != resource.RLIM_INFINITY and files < LEAST_FILES:
        raise InertialError(Fact("too-few-files-allowed", allowed=files, needed=LEAST_FILES))
