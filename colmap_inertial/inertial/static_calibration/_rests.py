"""Find rests of a device in its own readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.sampling import Coverage
from colmap_inertial.core.types import ImuRecording


@dataclass(frozen=True, kw_only=True)
class RestLimits:
    """Limits of a rest."""

    #: Readings vary over windows of this length.
    window_s: float = 1.0
    #: A device that lies lies for longer than this, beside that.
    shortest_rest_s: float = 1.0
    #: How quiet the quietest windows are: this share of them is quieter still.
    quietest: float = 0.05
    #: Thresholds that are tried, in standard deviations of the quietest windows.
    multiples: tuple[float, ...] = (3.0, 4.5, 7.0, 10.0)
    #: Standard deviations (all axes) beyond which a device is held in a hand, however steadily.
    held_m_s2: float = 0.5
    held_rad_s: float = 0.03
    #: Means over this time are taken for independent.
    block_s: float = 0.5
    #: Attitudes closer than this count once.
    same_attitude_rad: float = np.radians(15.0)


_LIMITS = RestLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Rests:
    """Stretches of a recording in which the device lay still.

    Attributes
    ----------
    begin_s, end_s
        (K,) on the recording's clock.
    accel_m_s2, gyro_rad_s
        (K, 3) mean readings.
    accel_sigma_m_s2, gyro_sigma_rad_s
        (K,) standard deviations of these means, each axis, by the readings' own scatter.
    accel_deviation_m_s2, gyro_deviation_rad_s
        Standard deviations of single readings in them, each axis.
    attitude
        (K,) number of the attitude, from 0; rests in one attitude share it.
    """

    begin_s: Array
    end_s: Array
    accel_m_s2: Array
    gyro_rad_s: Array
    accel_sigma_m_s2: Array
    gyro_sigma_rad_s: Array
    accel_deviation_m_s2: float
    gyro_deviation_rad_s: float
    attitude: IndexArray

    def __len__(self) -> int:
        return len(self.begin_s)

    @property
    def attitudes(self) -> int:
        """Number of attitudes."""
        return len(np.unique(self.attitude))


def candidate_rests(imu: ImuRecording) -> list[Rests]:
    """Rests by several thresholds on how much the readings vary, the strictest first (Tedaldi et al., ICRA 2014).

    The thresholds are multiples of how much they vary in the quietest windows of the recording.
    """
    accel = _window_variance(imu.accel_t_s, imu.accel_m_s2)
    gyro = _window_variance(imu.gyro_t_s, imu.gyro_rad_s)
    if accel is None or gyro is None:
        return []
    (t_s, accel_var), (gyro_t_s, gyro_var) = accel, gyro
    gyro_var = np.interp(t_s, gyro_t_s, gyro_var, left=np.inf, right=np.inf)
    half_s = 0.5 * _LIMITS.window_s
    whole = np.all([Coverage(s).covers(t_s - half_s, t_s + half_s) for s in (imu.accel_t_s, imu.gyro_t_s)], axis=0)
    if not whole.any():
        return []
    quiet_accel, quiet_gyro = (float(np.quantile(var[whole], _LIMITS.quietest)) for var in (accel_var, gyro_var))
    rests = []
    for multiple in _LIMITS.multiples:
        still = whole & (accel_var <= min(multiple**2 * quiet_accel, _LIMITS.held_m_s2**2))
        still &= gyro_var <= min(multiple**2 * quiet_gyro, _LIMITS.held_rad_s**2)
        spans = _spans(t_s, still)
        if len(spans) > 0:
            rests.append(_average_rests(imu, spans))
    return rests


def _window_variance(t_s: Array, values: Array) -> tuple[Array, Array] | None:
    """Variances over windows, summed over the axes, and the middles of the windows."""
    width = round(_LIMITS.window_s / float(np.median(np.diff(t_s))))
    if not 8 <= width < len(t_s):
        return None
    centred = values - values.mean(axis=0)

    def mean(samples: Array) -> Array:
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(samples, axis=0)])
        return np.asarray((total[width:] - total[:-width]) / width)

    # what is left where all readings are the same is rounding
    variance = np.maximum(np.sum(mean(centred**2) - mean(centred) ** 2, axis=1), 1e-12)
    first = (width - 1) // 2
    return t_s[first : first + len(variance)], variance


def _spans(t_s: Array, still: BoolArray) -> Array:
    """(K, 2) begin and end of what is still for long enough; the window around it reaches half its length further."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    spans = np.stack([t_s[edges[::2]], t_s[edges[1::2] - 1]], axis=1)
    return np.asarray(spans[spans[:, 1] - spans[:, 0] >= _LIMITS.shortest_rest_s])


def _average_rests(imu: ImuRecording, spans: Array) -> Rests:
    accel, accel_sigma, accel_deviation = _means(imu.accel_t_s, imu.accel_m_s2, spans)
    gyro, gyro_sigma, gyro_deviation = _means(imu.gyro_t_s, imu.gyro_rad_s, spans)
    return Rests(
        begin_s=spans[:, 0],
        end_s=spans[:, 1],
        accel_m_s2=accel,
        gyro_rad_s=gyro,
        accel_sigma_m_s2=accel_sigma,
        gyro_sigma_rad_s=gyro_sigma,
        accel_deviation_m_s2=accel_deviation,
        gyro_deviation_rad_s=gyro_deviation,
        attitude=_attitudes(accel),
    )


def _means(t_s: Array, values: Array, spans: Array) -> tuple[Array, Array, float]:
    """Means over spans, their standard deviations by those of blocks, and that of single readings."""
    means, counts, block_squares, squares, freedom, singles = [], [], 0.0, 0.0, 0, 0
    for begin_s, end_s in spans:
        inside = slice(*np.searchsorted(t_s, [begin_s, end_s]))
        count = int((end_s - begin_s) / _LIMITS.block_s)
        block = np.minimum(((t_s[inside] - begin_s) / (end_s - begin_s) * count).astype(int), count - 1)
        size = np.bincount(block, minlength=count)
        sums = np.stack([np.bincount(block, column, count) for column in values[inside].T], axis=1)
        blocks = sums[size > 0] / size[size > 0, None]
        mean = values[inside].mean(axis=0)
        means.append(mean)
        counts.append(len(blocks))
        block_squares += float(np.sum((blocks - blocks.mean(axis=0)) ** 2))
        freedom += 3 * (len(blocks) - 1)
        squares += float(np.sum((values[inside] - mean) ** 2))
        singles += values[inside].size
    sigma = np.sqrt(block_squares / max(freedom, 1) / np.array(counts))
    return np.array(means), sigma, float(np.sqrt(squares / max(singles, 1)))


def _attitudes(accel: Array) -> IndexArray:
    """The number of each rest's attitude: that of the first one that is near."""
    up = accel / np.linalg.norm(accel, axis=1, keepdims=True)
    known: list[Array] = []
    number = np.zeros(len(up), dtype=np.intp)
    for i, direction in enumerate(up):
        cosines = np.array([direction @ other for other in known])
        near = len(known) > 0 and cosines.max() > np.cos(_LIMITS.same_attitude_rad)
        number[i] = int(np.argmax(cosines)) if near else len(known)
        if not near:
            known.append(direction)
    return number
