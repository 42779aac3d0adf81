"""Metric, gravity-aligned COLMAP reconstructions from the gyroscope and accelerometer recorded with the images.

The public names stand in ``__init__.pyi``, once, for type checkers and for this module. Each loads its home when it is
first used; importing the package itself costs nothing.
"""

import sys as _sys
import warnings as _warnings

# pycolmap's wheel carries a zlib of its own; unless Python's is loaded first, a later zlib.compress aborts the process.
import zlib as _zlib  # noqa: F401
from importlib import import_module as _import_module
from importlib.abc import Loader as _Loader, MetaPathFinder as _Finder
from importlib.machinery import ModuleSpec as _ModuleSpec
from types import ModuleType as _ModuleType

import lazy_loader as _lazy

__version__ = "0.2.0"

#: Documented modules that moved, by their former names: these work for one more release.
_MOVED = {
    "colmap_inertial.exposure_pairs": "colmap_inertial.imaging.exposure_pairs",
    "colmap_inertial.restoration": "colmap_inertial.imaging.restoration",
}


class _MovedModules(_Finder, _Loader):
    """Imports a module that moved under its former name, too."""

    def find_spec(self, fullname: str, *_: object) -> _ModuleSpec | None:
        return _ModuleSpec(fullname, self) if fullname in _MOVED else None

    def exec_module(self, module: _ModuleType) -> None:
        new = _MOVED[module.__name__]
        _warnings.warn(f"{module.__name__} is now {new}", DeprecationWarning, stacklevel=2)
        _sys.modules[module.__name__] = _import_module(new)


_sys.meta_path.append(_MovedModules())

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
