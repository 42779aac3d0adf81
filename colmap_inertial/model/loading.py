"""COLMAP's library, loaded so that signals stay ours."""

from __future__ import annotations

import signal
import sys
import threading


def load_pycolmap() -> None:
    """Load it, and keep our answer to SIGTERM: its logging library takes it away and prints a trace in place of it."""
    first = "pycolmap" not in sys.modules
    import pycolmap  # noqa: F401

    if not first or threading.current_thread() is not threading.main_thread():
        return
    ours = signal.getsignal(signal.SIGTERM)  # what Python was told last, which loading does not change
    if ours is not None:
        signal.signal(signal.SIGTERM, ours)
