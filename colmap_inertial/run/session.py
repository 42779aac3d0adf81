"""A run from its lock to its log."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

from colmap_inertial.errors import InertialError

log = logging.getLogger(__name__)


@contextlib.contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Send this package's log to a file, and keep COLMAP's chatter off the terminal."""
    keep_colmap_quiet()
    logger = logging.getLogger("colmap_inertial")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except InertialError as error:
        log.error("%s", error)
        raise
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()


def keep_colmap_quiet() -> None:
    """Keep COLMAP's chatter off the terminal, from now on."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
