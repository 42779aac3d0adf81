"""Checks that make values valid by construction; what fails here is a programmer's mistake, hence ``ValueError``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from colmap_inertial.core.arrays import Array


def checked_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """A read-only float64 copy of ``value``; ``None`` in ``shape`` means any length."""
    out = np.array(value, dtype=np.float64)
    if out.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, out.shape, strict=True)):
        wanted = tuple("N" if n is None else n for n in shape)
        raise ValueError(f"{name}: shape {out.shape}, expected {wanted}")
    if not np.isfinite(out).all():
        raise ValueError(f"{name}: contains values that are not finite")
    out.setflags(write=False)
    return out


def checked_times(name: str, value: ArrayLike) -> Array:
    out = checked_array(name, value, (None,))
    if np.any(np.diff(out) <= 0):
        raise ValueError(f"{name}: times must increase strictly")
    return out


def checked_quaternions(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    out = checked_array(name, value, shape)
    norm = np.linalg.norm(out, axis=-1, keepdims=True)
    if np.any(np.abs(norm - 1) > 1e-3):
        raise ValueError(f"{name}: quaternions must have unit norm")
    out = out / norm
    out.setflags(write=False)
    return out


def checked_covariance(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    out = checked_array(name, value, shape)
    diagonal = np.diagonal(out, axis1=-2, axis2=-1)
    if np.any(diagonal < 0) or not np.allclose(out, np.swapaxes(out, -1, -2), rtol=1e-6, atol=1e-30):
        raise ValueError(f"{name}: not a covariance (must be symmetric with a non-negative diagonal)")
    return out


def set_fields(instance: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(instance, name, value)
