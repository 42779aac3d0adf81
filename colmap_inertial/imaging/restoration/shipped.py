"""The files of the networks that come with the package, and whether they are whole."""

from __future__ import annotations

import hashlib
import json
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Literal

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact

NetworkName = Literal["deepgyro", "lsd2"]


def folder() -> Traversable:
    """Folder of the files, with ``checksums.json``."""
    return files("colmap_inertial.imaging.restoration").joinpath("weights")


def model_file(name: NetworkName) -> Traversable:
    """The ONNX file of a network."""
    return folder().joinpath(f"{name}.onnx")


def checksum(name: NetworkName) -> str:
    """SHA-256 that the file of a network must have.

    Raises
    ------
    FormatError
        Where it is not known.
    """
    file = folder().joinpath("checksums.json")
    try:
        expected = json.loads(file.read_bytes())[f"{name}.onnx"]
    except FileNotFoundError:
        raise FormatError(str(file), Fact("checksums-missing", network=name)) from None
    except (ValueError, LookupError, TypeError):
        raise FormatError(str(file), Fact("checksum-unstated", network=name)) from None
    if not isinstance(expected, str):
        raise FormatError(str(file), Fact("checksum-unstated", network=name))
    return expected


def read_model(name: NetworkName) -> bytes:
    """Content of the ONNX file of a network.

    Raises
    ------
    FormatError
        Where it is missing or damaged.
    """
    expected = checksum(name)
    file = model_file(name)
    try:
        model = file.read_bytes()
    except FileNotFoundError:
        raise FormatError(str(file), Fact("network-missing")) from None
    if hashlib.sha256(model).hexdigest() != expected:
        raise FormatError(str(file), Fact("network-damaged", size_bytes=len(model)))
    return model
