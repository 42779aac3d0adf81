"""Which version of a library the tests run with, where results depend on it."""

import importlib


def version_of(module: str) -> tuple[int, ...]:
    """Major and minor, as imported: of several distributions that bring a module, the last one installed counts."""
    return tuple(int(part) for part in importlib.import_module(module).__version__.split(".")[:2])
