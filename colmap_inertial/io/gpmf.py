"""GPMF, the telemetry that GoPro cameras write into their MP4 files: payloads, streams, clocks.

A payload (one sample of the ``gpmd`` track, about a second) is a row of big-endian entries: four letters, a type
letter, the bytes of one sample, the number of samples, then the samples, padded to four bytes. Type 0 nests: ``DEVC`` a
device (``DVID``, ``DVNM``), ``STRM`` one of its streams, whose last entry is the data and whose others describe it:
``SCAL`` divides, ``SIUN`` names the unit, ``STMP`` (microseconds; HERO8 and later, MAX, Fusion) or ``TICK``
(milliseconds) stamps the payload's first sample, ``TSMP`` counts the samples so far, ``TIMO`` says by how many seconds
they are late. ``ORIN`` names the camera's axis that each channel measures (small letters: its opposite), ``MTRX`` turns
the channels into the axes that ``ORIO`` names. ``TYPE`` has a letter for each channel of a compound (type ``?``).
Described in github.com/gopro/gpmf-parser; the clocks are up to 1 % off.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact

_ENTRY = struct.Struct(">4scBH")
#: numpy's name of each type letter.
_TYPES = {
    b"b": ">i1",
    b"B": ">u1",
    b"s": ">i2",
    b"S": ">u2",
    b"l": ">i4",
    b"L": ">u4",
    b"q": ">i4",
    b"Q": ">i8",
    b"f": ">f4",
    b"d": ">f8",
    b"j": ">i8",
    b"J": ">u8",
}
_FIXED_POINT = {b"q": 2.0**16, b"Q": 2.0**32}
_NESTED, _COMPOUND = b"\0", b"?"
#: What describes the sample after it, and is no sample: ``SCAL`` does not divide it.
_UNSCALED = ("GPSF", "GPSP", "TMPC")
#: By the kind of stamp: payloads to either side that smooth it (milliseconds jitter by two, microseconds by 0.02,
#: payloads without stamps by a few samples), and how much more time than usual for its samples means a loss.
_REACH = {"STMP": 2, "TICK": 15, "track": 15}
_LOST_SHARE = {"STMP": 0.02, "TICK": 0.02, "track": 0.05}


@dataclass(frozen=True, eq=False)
class Entry:
    """One entry: four letters, type, bytes of a sample, number of samples, contents, place in the payload."""

    key: str
    type: bytes
    size: int
    count: int
    data: bytes
    at: int

    def numbers(self, members: str = "") -> Array:
        """(count, channels) values; fixed-point types as fractions. ``members``: types of a compound entry's."""
        if self.type == _COMPOUND:
            return self._compound(members)
        kind = _TYPES.get(self.type)
        if kind is None or self.size % np.dtype(kind).itemsize:
            raise ValueError(Fact("gpmf-samples-of-type", key=self.key, size=self.size, type=repr(self.type)))
        with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
            values = np.frombuffer(self.data, kind).astype(np.float64).reshape(self.count, -1)
        return values / _FIXED_POINT.get(self.type, 1.0)

    def _compound(self, members: str) -> Array:
        kinds = [_TYPES.get(letter.encode("latin-1")) for letter in members]
        rows = np.dtype([(f"f{i}", kind) for i, kind in enumerate(kinds) if kind is not None])
        if not kinds or None in kinds or rows.itemsize != self.size:
            raise ValueError(Fact("gpmf-samples-of-types", key=self.key, size=self.size, types=repr(members)))
        values = np.frombuffer(self.data, rows)
        with np.errstate(invalid="ignore"):
            columns = [values[name].astype(np.float64) for name in rows.names or ()]
        per_one = [_FIXED_POINT.get(letter.encode("latin-1"), 1.0) for letter in members]
        return np.stack(columns, axis=1) / per_one

    def text(self) -> str:
        """The contents as text, up to the first zero."""
        return self.data.split(b"\0")[0].decode("latin-1").strip()


@dataclass(eq=False)
class Stream:
    """One stream of one device, collected over all payloads.

    Attributes
    ----------
    payload, count
        In which payloads it occurs, and with how many samples.
    stamp_ns, stamp_kind
        The stamps of each of these payloads' first samples, and what they come from; empty where there are none.
    about
        The describing entries of the payload that had them first.
    """

    key: str
    device: str
    payload: list[int] = field(default_factory=list)
    data: list[Array] = field(default_factory=list)
    stmp_us: list[int | None] = field(default_factory=list)
    tick_ms: list[int | None] = field(default_factory=list)
    about: dict[str, Entry] = field(default_factory=dict)

    @property
    def values(self) -> Array:
        """(N, channels) scaled samples of the whole recording."""
        return np.concatenate(self.data)

    @property
    def count(self) -> Int64Array:
        """(P,) samples in each payload."""
        return np.array([len(part) for part in self.data], dtype=np.int64)

    def text(self, key: str) -> str:
        """A describing text, empty where there is none."""
        return self.about[key].text() if key in self.about else ""

    def stamps(self, track_ns: Int64Array) -> tuple[Int64Array, str]:
        """(P,) when each payload's first sample was taken, by the best clock there is; and which.

        Parameters
        ----------
        track_ns
            Presentation times of all payloads: the clock of streams without stamps.
        """
        for kind, stamps, unit_ns in (("STMP", self.stmp_us, 1000), ("TICK", self.tick_ms, 1_000_000)):
            if stamps and None not in stamps:
                # clocks since power-on, far from overflow; a damaged one is stopped by the checks on the samples
                stamps_ns = [min(stamp or 0, 1 << 52) * unit_ns for stamp in stamps]
                return np.array(stamps_ns, dtype=np.int64), kind
        return track_ns[self.payload], "track"

    def sample_times_ns(self, track_ns: Int64Array) -> Int64Array:
        """(N,) when each sample was taken, by the clock of :meth:`stamps`; see :func:`spread`."""
        stamps, kind = self.stamps(track_ns)
        late_ns = 0
        if "TIMO" in self.about:
            late_ns = round(float(self.about["TIMO"].numbers()[0, 0]) * 1e9)
        return spread(stamps, self.count, _REACH[kind], _LOST_SHARE[kind]) - late_ns


def entries(payload: bytes, begin: int = 0, end: int | None = None) -> Iterator[Entry]:
    """The entries of a payload, or of one that nests; contents that go beyond the end raise ``ValueError``."""
    end = len(payload) if end is None else end
    at = begin
    while at + 8 <= end:
        key, kind, size, count = _ENTRY.unpack_from(payload, at)
        if key == b"\0\0\0\0":
            return
        length = size * count
        if at + 8 + length > end:
            entry = {"key": repr(key), "byte": at, "length": length, "left": end - at - 8}
            raise ValueError(Fact("gpmf-entry-beyond-payload", **entry))
        yield Entry(key.decode("latin-1"), kind, size, count, payload[at + 8 : at + 8 + length], at + 8)
        at += 8 + (length + 3) // 4 * 4


def read_streams(path: Path, payloads: list[bytes], offsets: list[int], wanted: set[str]) -> list[Stream]:
    """Collect streams over the payloads of a recording.

    Parameters
    ----------
    path, offsets
        For messages: the file, and where in it each payload lies.
    wanted
        Keys of the data to collect.

    Raises
    ------
    FormatError
        Where an entry of a payload goes beyond it, or holds another kind of samples than it says.
    """
    streams: dict[tuple[str, str, str], Stream] = {}
    for index, payload in enumerate(payloads):
        try:
            for device in entries(payload):
                if device.key == "DEVC" and device.type == _NESTED:
                    _read_device(device, index, streams, wanted)
        except ValueError as error:
            raise FormatError(
                path, Fact("gpmf-payload-damaged", payload=index + 1, byte=offsets[index], detail=str(error))
            ) from None
    return list(streams.values())


def _read_device(device: Entry, index: int, streams: dict[tuple[str, str, str], Stream], wanted: set[str]) -> None:
    identity = name = ""
    tick: dict[str, Entry] = {}
    for entry in entries(device.data):
        if entry.key == "DVID":
            identity = entry.data.hex()
        elif entry.key == "DVNM":
            name = entry.text()
        elif entry.key == "TICK":
            # the device's own, for streams without one
            tick = {"TICK": entry}
        elif entry.key == "STRM" and entry.type == _NESTED:
            inside = {**tick, **{item.key: item for item in entries(entry.data)}}
            for key in wanted & inside.keys():
                stream = streams.setdefault((identity, name, key), Stream(key, name))
                # a device with two streams of one kind keeps the first
                if not stream.payload or stream.payload[-1] != index:
                    _append(stream, index, inside[key], inside)


def _append(stream: Stream, index: int, data: Entry, inside: dict[str, Entry]) -> None:
    if data.count == 0 or (data.key == "TMPC" and (data.type, data.size) != (b"f", 4)):
        return  # a temperature that is none of the usual spoils no recording
    values = data.numbers(inside["TYPE"].text() if "TYPE" in inside else "")
    if "SCAL" in inside and data.key not in _UNSCALED:
        scale = inside["SCAL"].numbers().ravel()
        if len(scale) not in (1, values.shape[1]) or not (np.isfinite(scale) & (scale != 0)).all():
            raise ValueError(Fact("gpmf-scale", key=data.key, channels=values.shape[1], scale=scale))
        values = values / scale
    if stream.data and stream.data[-1].shape[1] != values.shape[1]:
        old, new = stream.data[-1].shape[1], values.shape[1]
        raise ValueError(Fact("gpmf-channels-change", key=data.key, old=old, new=new))
    stream.payload.append(index)
    stream.data.append(values)
    stream.stmp_us.append(_stamp(inside, "STMP"))
    stream.tick_ms.append(_stamp(inside, "TICK"))
    stream.about = {**inside, **stream.about}


def _stamp(inside: dict[str, Entry], key: str) -> int | None:
    entry = inside.get(key)
    if entry is None or entry.type not in (b"J", b"L") or entry.size not in (4, 8) or entry.count < 1:
        return None
    return int.from_bytes(entry.data[: entry.size], "big")


def spread(stamp_ns: Int64Array, count: Int64Array, reach: int, lost_share: float) -> Int64Array:
    """Times of samples, from the stamps of the first sample of each payload.

    Samples are even within a payload, stamps jitter by what the camera was busy with. So a line is fitted to the stamps
    around each payload against the number of samples, and samples lie evenly between the fitted stamps. Where samples
    were lost, a payload has too few of them for its time; there the lines end and begin anew. A first payload with too
    many holds some from before the recording; its own stamp is left out.

    Parameters
    ----------
    stamp_ns, count
        (P,) stamp of each payload's first sample, and its number of samples.
    reach
        Payloads to either side that a line is fitted to.
    lost_share
        How much longer than the others' a payload's step may be before samples count as lost.
    """
    n = len(count)
    if n == 1:
        raise ValueError(Fact("gpmf-one-payload"))
    step_ns = np.diff(stamp_ns) / count[:-1]
    usual_ns = float(np.median(step_ns))
    if usual_ns <= 0:
        raise ValueError(Fact("gpmf-stamps-do-not-increase"))
    breaks = np.flatnonzero(step_ns > (1 + lost_share) * usual_ns) + 1
    out = np.empty(int(count.sum()), dtype=np.int64)
    first = np.concatenate([[0], np.cumsum(count)])
    for begin, end in zip([0, *breaks.tolist()], [*breaks.tolist(), n], strict=True):
        early = int(begin == 0 and end > 2 and step_ns[0] < (1 - lost_share) * usual_ns)
        used = slice(begin + early, end)
        stamps = (stamp_ns[used] - stamp_ns[begin]).astype(np.float64)
        starts = (first[begin : end + 1] - first[begin]).astype(np.float64)
        fitted, slope = _local_lines(stamps, starts[early:-1], reach, usual_ns)
        if early:
            fitted, slope = np.append(fitted[0] - slope[0] * count[0], fitted), np.append(slope[0], slope)
        # the end of the last payload, so that its samples follow at the rate before it
        knots = np.append(fitted, fitted[-1] + slope[-1] * count[end - 1])
        inner = np.interp(np.arange(starts[-1]), starts, knots)
        out[first[begin] : first[end]] = stamp_ns[begin] + np.rint(inner).astype(np.int64)
    return out


def _local_lines(y: Array, x: Array, reach: int, usual: float) -> tuple[Array, Array]:
    """Value and slope at each point of a line through the points around it; ``usual`` is the slope of a lone point."""
    if len(y) == 1:
        return y, np.array([usual])
    value, slope = np.empty(len(y)), np.empty(len(y))
    for i in range(len(y)):
        low = max(0, min(i - reach, len(y) - 2 * reach - 1))
        near = slice(low, low + 2 * reach + 1)
        dx, dy = x[near] - x[near].mean(), y[near] - y[near].mean()
        slope[i] = (dx @ dy) / (dx @ dx)
        value[i] = y[near].mean() + slope[i] * (x[i] - x[near].mean())
    return value, slope
