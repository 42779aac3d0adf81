"""What the columns of a table hold, by their names: which is the time, which are gyroscope and accelerometer, in which
units. What neither header nor definition of an export says stays open; numbers never decide a unit or a sign.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io import vocabulary as words
from colmap_inertial.io.sensor_columns import OPEN, ROWS, Columns, SensorColumns
from colmap_inertial.io.stamps import TimeColumns, is_date
from colmap_inertial.io.tables import Table, split_unit
from colmap_inertial.io.units import SENSOR_UNITS, TIME_UNITS_NS, Quantity, unit_and_scale
from colmap_inertial.io.vocabulary import LAYOUTS, ROS2_ECHO, Bare, Layout, Part

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[\u3400-\u9fff]+|[^\W\d_]+")
_LETTERS = {**{letter: i for i, letter in enumerate("xyz")}, **{str(i): i for i in range(3)}}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A name in a header.

    Attributes
    ----------
    kind
        ``gyro``, ``accel``, ``time``, ``linear`` (acceleration without gravity), ``gravity``, ``axis`` (nothing but an
        axis), or ``other``.
    words
        Of the name, small, without those of axis and unit.
    axis
        0, 1, 2, or ``None``.
    unit
        In our spelling; ``None`` where it does not say, or another one.
    scale
        How many of what it spells make one unit.
    """

    kind: str
    words: tuple[str, ...]
    axis: int | None
    unit: str | None
    scale: float = 1.0


def recognise_columns(table: Table) -> Columns:
    """What the columns of a table hold."""
    if table.header is None:
        return _bare(table) or Columns(gyro=SensorColumns(), accel=SensorColumns())
    cells = [read_name(name) for name in table.header]
    found = next((taken for layout in LAYOUTS if (taken := _match_layout(table, layout)) is not None), None)
    found = found or _match_words(table, cells)
    kinds = [cell.kind for cell in cells]
    for quantity, sensor in (("gyro", found.gyro), ("accel", found.accel)):
        for index in sensor.columns or ():
            kinds[index] = quantity
    return replace(found, kinds=tuple(kinds))


# --- names ------------------------------------------------------------------------------------------------------------


def name_words(name: str) -> list[str]:
    """The words of a name in small letters: ``gyroX_Raw`` is ``gyro``, ``x``, ``raw``."""
    return [token.lower() for token in _WORD.findall(name)]


def read_name(name: str) -> Cell:
    """What one name in a header says."""
    bare, unit_text = split_unit(name)
    if unit_text is not None and unit_text.isdigit():  # gyroADC[0]
        bare, unit_text = f"{bare} {unit_text}", None
    tokens = name_words(bare.lstrip("%#"))
    tokens = [part for token in tokens for part in _split_axis(token)]
    unit = None if unit_text is None else unit_and_scale(unit_text)
    if unit is None:
        tokens, unit = _unit_at_the_end(tokens)
    if unit is None and len(tokens) > 2 and tokens[-1] in ("x", "y", "z"):  # gyro_rad_s.x
        before, unit = _unit_at_the_end(tokens[:-1])
        tokens = [*before, tokens[-1]]
    if (
        unit is None
        and len(tokens) == 1
        and ((tokens[0] in words.TIME and len(tokens[0]) > 4) or tokens[0] in ("ms", "us"))
    ):
        unit = unit_and_scale(tokens[0])  # millis
    place = _axis_place(tokens)
    axis = None if place is None else _LETTERS[tokens[place]]
    rest = tuple(token for i, token in enumerate(tokens) if i != place)
    kind = _kind(rest, axis, None if unit is None else unit[0])
    name_of_unit, scale = unit or (None, 1.0)
    return Cell(kind=kind, words=rest, axis=axis, unit=name_of_unit, scale=scale)


def _axis_place(tokens: Sequence[str]) -> int | None:
    """Where the axis stands: the last x, y or z, or a number at the end."""
    places = [i for i, token in enumerate(tokens) if token in _LETTERS]
    letters = [i for i in places if tokens[i].isalpha()]
    if letters:
        return letters[-1]
    return places[-1] if places and places[-1] == len(tokens) - 1 else None


def _split_axis(token: str) -> list[str]:
    """``accx`` is ``acc`` and ``x``, as is ``xacc``."""
    stems = words.GYRO | words.ACCEL | words.SHORT_GYRO | words.SHORT_ACCEL
    if len(token) > 1 and token[0] in "xyz" and token[1:] in words.GYRO | words.ACCEL:
        return [token[1:], token[0]]
    return [token[:-1], token[-1]] if len(token) > 1 and token[-1] in "xyz" and token[:-1] in stems else [token]


def _unit_at_the_end(tokens: list[str]) -> tuple[list[str], tuple[str, float] | None]:
    """``UncalAccelXMps2`` and ``time since start in ms`` end with units; a single letter is none."""
    for count in (4, 3, 2, 1):
        last = "".join(tokens[-count:])
        if len(tokens) > count and len(last) > 1 and tokens[-count] not in ("x", "y", "z"):
            unit = unit_and_scale(last)
            if unit is not None:
                rest = tokens[:-count]
                return rest[:-1] if rest[-1:] == ["in"] else rest, unit
    return tokens, None


def _kind(rest: Sequence[str], axis: int | None, unit: str | None) -> str:
    have, joined = set(rest), "".join(rest)
    if have & words.TIME or joined in words.TIME or (joined in ("ms", "us") and axis is None):
        return "other" if axis is not None or have & (words.NO_TIME | words.OTHER - {"dt"}) else "time"
    if axis is None or have & (words.OTHER | words.WORLD):
        return "other"
    if have & words.GRAVITY:
        return "gravity"
    quantity = _quantity(rest, unit)
    if have & words.NO_GRAVITY:
        return "linear" if quantity == "accel" or have & {"linacc", "linaccel", "freeacc"} else "other"
    if quantity is not None:
        return quantity if unit is None or unit in SENSOR_UNITS[quantity] else "other"
    if joined in ("", "axis", "rate", "rateofturn", *words.VALUES):
        return next((quantity for quantity, units in SENSOR_UNITS.items() if unit in units), "axis")
    return "other"


def _quantity(rest: Sequence[str], unit: str | None) -> Quantity | None:
    """The sensor that words name."""
    have, joined, pairs = set(rest), "".join(rest), set(itertools.pairwise(rest))
    is_gyro = bool(have & words.GYRO or pairs & words.GYRO_PAIRS) or joined in words.GYRO | words.SHORT_GYRO
    is_accel = bool(have & words.ACCEL or pairs & words.ACCEL_PAIRS) or joined in words.ACCEL | words.SHORT_ACCEL
    if is_gyro and not (is_accel and unit in SENSOR_UNITS["accel"]):
        return "gyro"
    return "accel" if is_accel else None


# --- by words ---------------------------------------------------------------------------------------------------------


def _match_words(table: Table, cells: Sequence[Cell]) -> Columns:
    gyro, accel = find_sensor(table, cells, "gyro"), find_sensor(table, cells, "accel")
    unsaid = find_sensor(table, cells, "gyro", ("axis",))
    if (gyro.columns is None) != (accel.columns is None) and unsaid.columns is not None and unsaid.unit is None:
        proposed = replace(unsaid, about="the file does not say what these columns are")
        gyro, accel = (proposed, accel) if gyro.columns is None else (gyro, proposed)
    linear = find_sensor(table, cells, "accel", ("linear",))
    if accel.columns is None and linear.columns is not None and gyro.columns is not None:
        pair = cells[gyro.columns[0]].words[-2:], cells[linear.columns[0]].words[-2:]
        if pair in words.ROS_PAIRS:
            about = "gravity is in it where this comes from sensor_msgs/Imu of ROS, and not where it is a phone's"
            accel = replace(linear, unit=None, about=about)
        else:
            accel = replace(accel, about="what it has is without gravity")
    sure = gyro.is_complete and accel.is_complete
    why = ["the header names the columns and their units"] if sure else []
    return Columns(gyro=gyro, accel=accel, is_sure=sure, why=tuple(why))


def find_sensor(table: Table, cells: Sequence[Cell], quantity: Quantity, kinds: tuple[str, ...] = ()) -> SensorColumns:
    """The columns of a sensor: of several those of the fewest doubtful words.

    Parameters
    ----------
    kinds
        Of cells that may be this sensor's; by default those that say so.
    """
    assert table.header is not None
    groups: dict[tuple[str, ...], dict[int, int]] = {}
    twice: set[tuple[str, ...]] = set()
    for index, cell in enumerate(cells):
        if cell.kind in (kinds or (quantity,)) and cell.axis is not None:
            group = groups.setdefault(cell.words, {})
            if cell.axis in group:
                twice.add(cell.words)
            group.setdefault(cell.axis, index)
    whole = [name for name, group in groups.items() if len(group) == 3 and name not in twice]
    time = _find_time(table, cells, quantity)
    if not whole:
        return SensorColumns(time=time)
    whole.sort(key=lambda name: (len(words.LESSER & set(name)), list(groups).index(name)))
    best = whole[0]
    equal = [name for name in whole[1:] if len(words.LESSER & set(name)) == len(words.LESSER & set(best))]
    columns = tuple(groups[best][axis] for axis in range(3))
    units = {(cells[i].unit, cells[i].scale) for i in columns}
    unit, scale = units.pop() if len(units) == 1 else (None, 1.0)
    return SensorColumns(
        columns=(columns[0], columns[1], columns[2]),
        unit=unit,
        counts_per_unit=scale,
        time=time,
        others=tuple(table.header[groups[name][0]] for name in equal),
    )


def _find_time(table: Table, cells: Sequence[Cell], quantity: Quantity) -> TimeColumns | None:
    """The time of a sensor: its own before one of all, a clock near the sensor before a later one."""
    assert table.header is not None
    own = words.GYRO if quantity == "gyro" else words.ACCEL
    foreign = (words.GYRO | words.ACCEL | words.OTHER) - own
    scored: list[tuple[float, int, TimeColumns]] = []
    for index, cell in enumerate(cells):
        have = set(cell.words)
        if cell.kind != "time" or have & foreign:
            continue
        kind = column_kind(table, index)
        if kind not in ("number", "date"):
            continue
        unit = "date" if kind == "date" else cell.unit if cell.unit in TIME_UNITS_NS else None
        score = 2.0 * bool(have & own) + (unit is not None) + 0.5 * bool(have & words.NEAR_CLOCK)
        score -= 0.5 * bool(have & words.LATE_CLOCK) + 0.25 * (kind == "date")
        score -= 2.0 * _mostly_repeats(table, index)
        scored.append(
            (score, -index, TimeColumns(columns=(_name(table, index),), units=() if unit is None else (unit,)))
        )
    pair = _seconds_and_parts(table) or _date_and_time(table, cells)
    best = max(scored, key=lambda item: item[:2])[2] if scored else None
    if pair is not None and (best is None or set(best.columns) <= set(pair.columns) or max(scored)[0] < 1.4):
        return pair
    if best is not None:
        return best
    rate = find_rate(table.preamble)
    return None if rate is None else TimeColumns(rate_hz=rate)


def _mostly_repeats(table: Table, index: int) -> bool:
    """Whether most of the first cells are those above them: a clock too coarse for an IMU."""
    cells = [row.split(table.delimiter, index + 1)[index] for row in table.lines[:ROWS]]
    return 2 * sum(a == b for a, b in itertools.pairwise(cells)) > len(cells)


def _seconds_and_parts(table: Table) -> TimeColumns | None:
    """Whole seconds and what is below them, in two columns of otherwise equal names."""
    found: dict[tuple[str, ...], dict[str, int]] = {}
    for index, name in enumerate(table.header or ()):
        tokens = tuple(name_words(split_unit(name)[0]))
        for part, spelled in words.PARTS.items():
            if tokens and tokens[-1] in spelled and not set(tokens) & words.OTHER:
                found.setdefault(tokens[:-1], {}).setdefault(part, index)
    for parts in found.values():
        below = next((part for part in ("ns", "us", "ms") if part in parts), None)
        if "s" in parts and below is not None:
            return TimeColumns(columns=(_name(table, parts["s"]), _name(table, parts[below])), units=("s", below))
    return None


def _date_and_time(table: Table, cells: Sequence[Cell]) -> TimeColumns | None:
    days = [i for i in range(table.width) if re.fullmatch(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}", _first(table, i))]
    hours = [i for i in range(table.width) if re.match(r"\d{1,2}:\d{1,2}:\d", _first(table, i))]
    if len(days) != 1 or len(hours) != 1:
        return None
    return TimeColumns(columns=(_name(table, days[0]), _name(table, hours[0])), units=("date",))


def _first(table: Table, index: int) -> str:
    return table.lines[0].split(table.delimiter)[index].strip().strip('"').strip() if len(table) else ""


def _name(table: Table, index: int) -> str | int:
    """A column's name, or its number where the name is none or another's, too."""
    name = "" if table.header is None else table.header[index]
    return name if name and (table.header or ()).count(name) == 1 else index + 1


def column_kind(table: Table, index: int) -> str:
    """``number`` (it changes and mostly grows), ``date``, ``constant``, ``other``; by the first rows."""
    rows = table.lines[:ROWS]
    cells = [row.split(table.delimiter, index + 1)[index].strip().strip('"').strip() for row in rows]
    filled = [cell for cell in cells if cell]
    if not filled:
        return "constant"
    try:
        values = np.array([float(cell) for cell in filled])
    except ValueError:
        if not all(is_date(cell) and ":" in cell for cell in filled[:50]):
            return "other"
        return "date" if len(set(filled)) > 1 else "constant"
    if not np.isfinite(values).any():
        return "constant"
    steps = np.diff(values)
    if not np.isfinite(values).all() or not (steps > 0).any():
        return "constant" if not steps.any() else "other"
    return "number" if (steps < 0).mean() < 0.05 else "other"


def find_rate(lines: Iterable[str]) -> float | None:
    """The one sampling rate that lines before a header state, in Hz."""
    rates = {float(rate) for line in lines for rate in re.findall(words.RATE, line, re.IGNORECASE)}
    rate = rates.pop() if len(rates) == 1 else 0.0
    return rate if 0 < rate < 1e5 else None


# --- exports ----------------------------------------------------------------------------------------------------------


def _flat(name: str) -> str:
    return re.sub(r"\s+", " ", name.strip().lower())


def _match_layout(table: Table, layout: Layout) -> Columns | None:
    """The columns of an export, where the table is one."""
    assert table.header is not None
    names = [_flat(name) for name in table.header]
    if any(need not in names for need in layout.needs):
        return None
    if layout.preamble and not re.search(layout.preamble, "\n".join(table.preamble)):
        return None
    sensors = []
    for part in (layout.gyro, layout.accel):
        sensor = _match_part(table, names, layout, part)
        if sensor is None or sensor.columns is None:
            return None
        sensors.append(sensor)
    gyro, accel = sensors
    sure = layout.is_defined and gyro.is_complete and accel.is_complete
    return Columns(
        gyro=gyro,
        accel=accel,
        source=layout.name,
        is_sure=sure,
        why=(f"the columns are those of {layout.name}, which defines their units",),
    )


def _match_part(table: Table, names: Sequence[str], layout: Layout, part: Part) -> SensorColumns | None:
    wanted = [part.columns.format(letter) for letter in layout.letters]
    if not wanted[0].startswith("field.") and layout.name.startswith("sensor_msgs"):
        places = [_ending(names, name) for name in wanted]
    else:
        places = [names.index(name) if name in names else None for name in wanted]
    if None in places:
        return None
    time = _layout_time(table, names, part)
    if time is None and not part.times and (rate := find_rate(table.preamble)) is not None:
        time = TimeColumns(rate_hz=rate)
    is_dated = part.are_dated_otherwise and time is not None and time.units == ("date",)
    counts = part.counts_per_unit
    if counts is None:
        counts = _find_counts(table.preamble, layout.preamble_counts)
    return SensorColumns(
        columns=(places[0], places[1], places[2]),  # type: ignore[arg-type]
        unit=part.unit,
        counts_per_unit=counts,
        axes=OPEN if is_dated else part.axes,
        time=time,
        about=part.about if part.unit is None or counts is None or is_dated else "",
    )


def _ending(names: Sequence[str], wanted: str) -> int | None:
    """The one column whose name ends with this one, after a dot, a slash or nothing."""
    found = [i for i, name in enumerate(names) if name == wanted or name.endswith((f".{wanted}", f"/{wanted}"))]
    return found[0] if len(found) == 1 else None


def _layout_time(table: Table, names: Sequence[str], part: Part) -> TimeColumns | None:
    for times in part.times:
        places = [_ending(names, name) for name in times.columns]
        if None not in places and all(
            column_kind(table, p) != "constant" or len(places) > 1 for p in places if p is not None
        ):
            columns = tuple(_name(table, p) for p in places if p is not None)
            if len(places) == 1 and column_kind(table, places[0]) == "date":  # type: ignore[arg-type]
                return TimeColumns(columns=columns, units=("date",))
            if times.units == ("ns",) and _has_fractions(table, places[0]):  # type: ignore[arg-type]
                return TimeColumns(columns=columns)
            return TimeColumns(columns=columns, units=times.units, counts_per_second=times.counts_per_second)
    return None


def _has_fractions(table: Table, index: int) -> bool:
    """Whether the first stamps are no whole numbers."""
    values = table.numbers([index])[:ROWS, 0]
    return bool((np.abs(values) < 2**53).all() and (values != np.rint(values)).any())


def _find_counts(preamble: Sequence[str], key: str) -> float | None:
    """What a line ``key, number`` before the header says."""
    for line in preamble:
        match = re.match(rf'\s*"?{re.escape(key)}"?\s*[,;:=\t]\s*"?(\d+(?:\.\d+)?)"?\s*$', line, re.IGNORECASE)
        if match and float(match[1]) > 0:
            return float(match[1])
    return None


def _bare(table: Table) -> Columns | None:
    """A table without header whose rows are those of a known export."""
    kind: Bare = ROS2_ECHO
    if table.width != kind.width or len(table) < 2:
        return None
    try:
        values = table.numbers([i for i in range(kind.width) if i + 1 not in kind.texts])[:ROWS]
    except FormatError:
        return None
    seconds, nanoseconds = values[:, 0], values[:, 1]
    whole = (values[:, :2] == np.floor(values[:, :2])).all() and (nanoseconds >= 0).all() and (nanoseconds < 1e9).all()
    turned = values[:, 2:6]
    unit = np.abs(np.linalg.norm(turned, axis=1) - 1) < 1e-2
    moves = bool(np.diff(values[:, :2], axis=0).any())
    if not (
        whole
        and (np.diff(seconds) >= 0).mean() > 0.9
        and (unit.all() or (values[:, 6] == -1).all() or not turned.any())
    ):
        return None
    time = TimeColumns(columns=kind.time, units=kind.units) if moves else None

    def sensor(columns: tuple[int, int, int], unit: str) -> SensorColumns:
        x, y, z = columns
        return SensorColumns(columns=(x - 1, y - 1, z - 1), unit=unit, time=time)

    return Columns(
        gyro=sensor(kind.gyro, kind.gyro_unit),
        accel=sensor(kind.accel, kind.accel_unit),
        source=kind.name,
        is_sure=moves,
        why=(f"{kind.width} columns as {kind.name} writes them: seconds, nanoseconds, a unit quaternion",),
    )
