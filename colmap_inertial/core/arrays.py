"""Arrays of the whole package: their types by element, and the checks that make fields of values valid.

What fails a check here is a programmer's mistake, hence ``ValueError``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Float32Array = NDArray[np.float32]
ComplexArray = NDArray[np.complex128]
UInt8Array = NDArray[np.uint8]
UInt16Array = NDArray[np.uint16]
Int32Array = NDArray[np.int32]
Int64Array = NDArray[np.int64]
#: Positions in other arrays, as numpy's own functions give them.
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]

#: Times that span more (100 days) are in another unit than seconds.
LONGEST_S = 100 * 86400.0


def check_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """A read-only float64 copy of ``value``; ``None`` in ``shape`` means any length.

    Raises
    ------
    ValueError
        For another shape, and for values that are not finite; the message begins with ``name``.
    """
    try:
        out = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: is no array of numbers ({error})") from None
    if not _fits(out.shape, shape):
        wanted = tuple("N" if n is None else n for n in shape)
        turned = "; transpose it" if _fits(out.T.shape, shape) else ""
        raise ValueError(f"{name}: shape {out.shape}, expected {wanted}{turned}")
    if not np.isfinite(out).all():
        raise ValueError(f"{name}: contains values that are not finite")
    out.setflags(write=False)
    return out


def _fits(actual: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(actual) == len(shape) and all(n is None or n == m for n, m in zip(shape, actual, strict=True))


def check_field(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """:func:`check_array`, and the check that the end of the name implies.

    Times (``t_s``) increase strictly, quaternions (``xyzw``) have unit norm and are normalised, covariances (``cov``)
    are symmetric with a non-negative diagonal.
    """
    out = check_array(name, value, shape)
    if name.endswith("t_s"):
        check_increasing(name, out)
    elif name.endswith("xyzw"):
        norm = np.linalg.norm(out, axis=-1, keepdims=True)
        if np.any(np.abs(norm - 1) > 1e-3):
            raise ValueError(f"{name}: quaternions must have unit norm")
        out = out / norm
        out.setflags(write=False)
    elif name.endswith("cov"):
        diagonal = np.diagonal(out, axis1=-2, axis2=-1)
        if np.any(diagonal < 0) or not np.allclose(out, np.swapaxes(out, -1, -2), rtol=1e-6, atol=1e-30):
            raise ValueError(f"{name}: not a covariance (must be symmetric with a non-negative diagonal)")
    return out


def check_increasing(name: str, t_s: Array) -> None:
    """Raise ``ValueError`` unless times increase strictly, and are seconds: no recording lasts for months."""
    if np.any(np.diff(t_s) <= 0):
        raise ValueError(f"{name}: times must increase strictly")
    if len(t_s) > 1 and t_s[-1] - t_s[0] > LONGEST_S:
        raise ValueError(
            f"{name}: spans {t_s[-1] - t_s[0]:.3g}, in seconds {(t_s[-1] - t_s[0]) / 86400:.3g} days; give seconds, "
            "not nanoseconds, microseconds or milliseconds (the first timestamp as epoch_ns, where there is one)"
        )


def check_fields(instance: object, **shapes: tuple[int | str, ...]) -> None:
    """Replace array fields of a frozen value by what :func:`check_field` makes of them; an optional ``None`` stays.

    Parameters
    ----------
    shapes
        By field; a letter is a length that fields have in common.
    """
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        value = getattr(instance, name)
        if value is None and getattr(type(instance), name, ...) is None:
            continue
        out = check_field(name, value, tuple(lengths.get(n) if isinstance(n, str) else n for n in shape))
        lengths |= {letter: n for letter, n in zip(shape, out.shape, strict=True) if isinstance(letter, str)}
        set_fields(instance, **{name: out})


def set_fields(instance: object, **values: object) -> None:
    """Set fields of a frozen value while it is made."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)
