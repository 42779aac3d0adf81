"""Metric, gravity-aligned COLMAP reconstructions from the gyroscope and accelerometer that filmed along.

The public names stand in ``__init__.pyi``, once, for type checkers and for this module. Each loads its home when it is
first used; importing the package itself costs nothing.
"""

# pycolmap's wheel carries a zlib of its own; unless Python's is loaded first, a later zlib.compress aborts the process.
import zlib as _zlib  # noqa: F401

import lazy_loader as _lazy

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
