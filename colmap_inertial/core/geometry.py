"""Rotations and pixel conventions, batched over the leading axes. Quaternions are xyzw, as in COLMAP's Python.

A rotation ``a_from_b`` takes coordinates in frame b to coordinates in frame a; products cancel adjacent frames.
"""

from __future__ import annotations

import numpy as np

from colmap_inertial.core.arrays import Array


def cross(a: Array, b: Array) -> Array:
    """Cross products. Shapes (..., 3) broadcast. ``np.cross`` takes several times as long for a few vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return out


def skew(v: Array) -> Array:
    """Cross-product matrices: ``skew(v) @ x == cross(v, x)``. Shape (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _norm(v: Array) -> Array:
    """Lengths along the last axis, which stays with length one: ``np.linalg.norm`` is slow along a short axis."""
    squares = v * v
    total = squares[..., :1]
    for i in range(1, v.shape[-1]):
        total = total + squares[..., i : i + 1]
    return np.asarray(np.sqrt(total))


def quat_normalize(q: Array) -> Array:
    """Unit quaternions with non-negative scalar part, xyzw. Shape (..., 4)."""
    q = np.asarray(q, dtype=np.float64)
    norm = _norm(q)
    return np.asarray(q / np.where(q[..., 3:] < 0, -norm, norm))


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product of xyzw quaternions: the rotation ``b`` first, then ``a``. Shapes broadcast."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    # components spelled out: several times faster than np.cross, np.moveaxis and np.stack for a few quaternions
    x = aw * bx + bw * ax + ay * bz - az * by
    out = np.empty((*x.shape, 4))
    out[..., 0] = x
    out[..., 1] = aw * by + bw * ay + az * bx - ax * bz
    out[..., 2] = aw * bz + bw * az + ax * by - ay * bx
    out[..., 3] = aw * bw - ax * bx - ay * by - az * bz
    return out


def quat_conjugate(q: Array) -> Array:
    """The inverse of unit quaternions, xyzw."""
    return np.asarray(q, dtype=np.float64) * np.array([-1.0, -1.0, -1.0, 1.0])


def quat_rotate(q: Array, v: Array) -> Array:
    """Rotate vectors by unit quaternions xyzw. Shapes (..., 4), (..., 3) broadcast to (..., 3)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    t = 2 * cross(q[..., :3], v)
    return v + q[..., 3:] * t + cross(q[..., :3], t)


def matrix_from_quat(q: Array) -> Array:
    """Rotation matrices of xyzw quaternions (normalised first). Shape (..., 4) -> (..., 3, 3)."""
    q = quat_normalize(q)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return out


def quat_from_matrix(rotation: Array) -> Array:
    """Unit quaternions xyzw of rotation matrices (det = +1). Shape (..., 3, 3) -> (..., 4).

    The largest of the four squared components is computed first (Shepperd 1978), so there is no cancellation.
    """
    m = np.asarray(rotation, dtype=np.float64)
    d = np.diagonal(m, axis1=-2, axis2=-1)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    four_squares = np.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], axis=-1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    p, q, r = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    sx, sy, sz, sw = np.moveaxis(four_squares, -1, 0)
    candidates = np.stack(
        [np.stack(row, axis=-1) for row in ([sx, p, q, a], [p, sy, r, b], [q, r, sz, c], [a, b, c, sw])], axis=-2
    )
    best = np.argmax(four_squares, axis=-1)
    return quat_normalize(np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :])


def quat_exp(rotation_vector: Array) -> Array:
    """Unit quaternions xyzw of rotation vectors (rad). Shape (..., 3) -> (..., 4)."""
    v = np.asarray(rotation_vector, dtype=np.float64)
    angle = _norm(v)
    # np.sinc(x) = sin(pi x) / (pi x), finite at zero
    return np.concatenate([0.5 * np.sinc(angle / (2 * np.pi)) * v, np.cos(angle / 2)], axis=-1)


def quat_log(q: Array) -> Array:
    """Rotation vectors (rad, norm <= pi) of unit quaternions xyzw. Shape (..., 4) -> (..., 3)."""
    q = quat_normalize(q)
    norm = _norm(q[..., :3])
    angle = 2 * np.arctan2(norm, q[..., 3:])
    small = norm < 1e-9
    return np.where(small, 2.0, angle / np.where(small, 1.0, norm)) * q[..., :3]


def so3_exp(rotation_vector: Array) -> Array:
    """Rotation matrices of rotation vectors (rad), Rodrigues' formula. Shape (..., 3) -> (..., 3, 3)."""
    v = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(rotation: Array) -> Array:
    """Rotation vectors (rad, norm <= pi) of rotation matrices. Shape (..., 3, 3) -> (..., 3)."""
    return quat_log(quat_from_matrix(rotation))


def slerp(t_s: Array, xyzw: Array, query_s: Array) -> Array:
    """Spherical linear interpolation of a quaternion track.

    Parameters
    ----------
    t_s
        (N,) increasing times, N >= 2.
    xyzw
        (N, 4) unit quaternions at these times.
    query_s
        (M,) times; outside the track the nearest segment is continued.

    Returns
    -------
    (M, 4) unit quaternions xyzw.
    """
    t_s, q, query_s = np.asarray(t_s, float), np.asarray(xyzw, float), np.asarray(query_s, float)
    i = np.clip(np.searchsorted(t_s, query_s, side="right") - 1, 0, len(t_s) - 2)
    fraction = (query_s - t_s[i]) / (t_s[i + 1] - t_s[i])
    step = quat_log(quat_multiply(quat_conjugate(q[i]), q[i + 1]))
    return quat_normalize(quat_multiply(q[i], quat_exp(fraction[..., None] * step)))


#: Factors of a block of :func:`quat_cumulative`.
_BLOCK = 32
#: ``quat_multiply(a, b)`` as four sums (columns) of four terms (rows): component ``_OF_LEFT`` of ``a`` times component
#: ``_OF_RIGHT`` of ``[b, -b]``.
_OF_LEFT = np.array([[3, 3, 3, 3], [0, 1, 2, 0], [1, 2, 0, 1], [2, 0, 1, 2]])
_OF_RIGHT = np.array([[0, 1, 2, 3], [3, 3, 3, 4], [2, 0, 1, 5], [5, 6, 4, 6]])


def quat_cumulative(steps: Array) -> Array:
    """Running products ``[1, s0, s0 s1, s0 s1 s2, ...]`` of unit quaternions xyzw. Shape (N, 4) -> (N + 1, 4).

    In linear time: products within blocks, all blocks at once, then the blocks' own running products in front.
    """
    factors = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], np.asarray(steps, dtype=np.float64)])
    count = -(-len(factors) // _BLOCK)
    padded = np.tile([0.0, 0.0, 0.0, 1.0], (count * _BLOCK, 1))
    padded[: len(factors)] = factors
    products = _multiply_along_blocks(padded.reshape(count, _BLOCK, 4))
    if count > 1:
        before = quat_cumulative(products[:-1, -1])[1:]
        products[1:] = quat_multiply(before[:, None], products[1:])
    return quat_normalize(products.reshape(-1, 4)[: len(factors)])


def _multiply_along_blocks(blocks: Array) -> Array:
    """(G, B, 4) running products of each of G blocks of B quaternions, with the very sums of ``quat_multiply``."""
    products = np.ascontiguousarray(blocks.transpose(1, 2, 0))
    rights = np.concatenate([products, -products], axis=1)
    for i in range(1, len(products)):
        terms = products[i - 1, _OF_LEFT] * rights[i, _OF_RIGHT]
        # from -0.0, which keeps the sign of a zero
        np.add.reduce(terms, axis=0, out=products[i], initial=-0.0)
    return np.ascontiguousarray(products.transpose(2, 0, 1))


def rotation_between(a: Array, b: Array) -> Array:
    """The smallest rotation that takes direction ``a`` to direction ``b``, as a unit quaternion xyzw.

    Parameters
    ----------
    a, b
        (3,) non-zero vectors. Opposite directions turn about an axis perpendicular to ``a``.
    """
    u, v = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
    w = 1 + float(u @ v)
    if w < 1e-12:
        axis = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        return np.append(axis / np.linalg.norm(axis), 0.0)
    return quat_normalize(np.append(np.cross(u, v), w))


def find_tangents(unit: Array) -> Array:
    """(K, 3, 2) two directions perpendicular to each of (K, 3) unit vectors."""
    helper = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    first = np.cross(unit, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(unit, first)], axis=2)


def colmap_px_from_opencv(xy_px: Array) -> Array:
    """COLMAP's pixel coordinates from OpenCV's: the top-left pixel's centre is (0.5, 0.5) instead of (0, 0)."""
    return np.asarray(xy_px, dtype=np.float64) + 0.5


def opencv_px_from_colmap(xy_px: Array) -> Array:
    """Inverse of :func:`colmap_px_from_opencv`."""
    return np.asarray(xy_px, dtype=np.float64) - 0.5
