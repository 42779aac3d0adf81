"""Calibration targets of known size: what the user writes, and where the corners are.

Every target is planar. Coordinates are metres in the target's own frame, x along its columns, centred on the target;
single markers are targets of their own (``part``) that share nothing but their side's length.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.errors import InertialError
from colmap_inertial.core.facts import Fact

Kind = Literal["checkerboard", "charuco", "aprilgrid", "aruco"]

#: OpenCV's predefined marker dictionaries and how many markers each holds.
DICTIONARIES = {
    **{f"{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "ARUCO_ORIGINAL": 1024,
    "ARUCO_MIP_36H12": 250,
    "APRILTAG_16H5": 30,
    "APRILTAG_25H9": 35,
    "APRILTAG_36H10": 2320,
    "APRILTAG_36H11": 587,
}
#: The tag family of Kalibr's AprilGrid.
APRILGRID_DICTIONARY = "APRILTAG_36H11"

_FORMS = {
    "checkerboard": "checkerboard:COLSxROWS:SQUARE_M",
    "charuco": "charuco:COLSxROWS:SQUARE_M:MARKER_M:DICT",
    "aprilgrid": "aprilgrid:COLSxROWS:TAG_M:GAP",
    "aruco": "aruco:DICT:SIDE_M",
}
_LONGEST_M = 10.0


class TargetSpecError(InertialError):
    """The description of a target cannot be read.

    Parameters
    ----------
    spec
        What the user wrote.
    reason
        What is wrong with it.
    """

    def __init__(self, spec: str, reason: Fact) -> None:
        self.spec = spec
        kind = spec.split(":", 1)[0].strip().lower()
        known = kind if kind in _FORMS else None
        forms = tuple(_FORMS.values()) if known is None else (_FORMS[known],)
        super().__init__(Fact("target-unreadable", spec=spec, why=reason, kind=known, forms=forms))


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """A planar calibration target, or a dictionary of single markers.

    Attributes
    ----------
    spec
        The description it was made from.
    kind
        ``checkerboard``, ``charuco``, ``aprilgrid`` or ``aruco``.
    columns, rows
        Of inner corners, squares or tags, as in the description; 0 for single markers.
    length_m
        Side of a square (checkerboard, ChArUco), of a tag (AprilGrid) or of a marker.
    marker_m
        Side of a ChArUco board's markers; 0 elsewhere.
    gap
        Gap between the tags of an AprilGrid, divided by the tag's side; 0 elsewhere.
    dictionary
        Name in :data:`DICTIONARIES`; empty for a checkerboard.
    sigma_m
        How well ``length_m`` is known, as a standard deviation; ``None`` where the description does not say.
    corners_m
        (N, 3) corners in the frame of their part, z = 0.
    part
        (N,) rigid part that each corner belongs to: 0 for boards, the marker's number for single markers.
    row, column
        (N,) place of each corner in its part's grid of corners.
    relabelings
        (K, N) the ways in which a detector may number the corners of one view without showing it in the image, as
        permutations of the true numbers; the first is the identity.
    """

    spec: str
    kind: Kind
    columns: int = 0
    rows: int = 0
    length_m: float
    marker_m: float = 0.0
    gap: float = 0.0
    dictionary: str = ""
    sigma_m: float | None = None
    corners_m: Array
    part: IndexArray
    row: IndexArray
    column: IndexArray
    relabelings: IndexArray

    def label(self, corner: int) -> str:
        """A corner's name: ``r2c5`` (row, column), ``tag7.0`` or ``marker3.2`` (corner of a tag or marker)."""
        if self.kind == "aruco":
            return f"marker{corner // 4}.{corner % 4}"
        if self.kind == "aprilgrid":
            return f"tag{corner // 4}.{corner % 4}"
        return f"r{self.row[corner]}c{self.column[corner]}"

    def part_name(self, part: int) -> str:
        """Name of a rigid part in messages."""
        return f"marker {part}" if self.kind == "aruco" else self.kind

    def control(self, seen: BoolArray) -> BoolArray:
        """Indices of the corners that may set a scale; the rest check it.

        The two sets share no corner, so no corner's detection error is in both. Boards are split by every second
        line of corners along their longer side, AprilGrids tag by tag like the fields of a chessboard, single markers
        one by one; a lone marker gives one side to each set.

        Parameters
        ----------
        seen
            (N,) corners that were measured.

        Returns
        -------
        (N,) true for control corners.
        """
        if self.kind == "aprilgrid":
            tag = np.arange(len(self.part)) // 4
            return (tag // self.columns + tag % self.columns) % 2 == 0
        if self.kind == "aruco":
            parts, which = np.unique(self.part[seen], return_inverse=True)
            if len(parts) == 1:
                return np.arange(len(self.part)) % 4 < 2
            control = np.zeros(len(self.part), dtype=bool)
            control[seen] = which % 2 == 0
            return control
        line = self.column if np.ptp(self.column) >= np.ptp(self.row) else self.row
        return line % 2 == 0

    def pairs(self, seen: BoolArray) -> IndexArray:
        """Pairs of seen corners whose distances are reported.

        Every two corners of a row or of a column, and the two diagonals of the whole; of single markers the four
        sides and two diagonals.

        Parameters
        ----------
        seen
            (N,) corners that were measured.

        Returns
        -------
        (D, 2) corner numbers, in the order of the corners.
        """
        out: list[tuple[int, int]] = []
        for part in np.unique(self.part[seen]):
            corners = np.flatnonzero(seen & (self.part == part))
            last_row, last_column = self.row[self.part == part].max(), self.column[self.part == part].max()
            for a, b in combinations(corners.tolist(), 2):
                rows, columns = abs(self.row[a] - self.row[b]), abs(self.column[a] - self.column[b])
                if rows == 0 or columns == 0 or (rows == last_row and columns == last_column):
                    out.append((a, b))
        return np.array(out, dtype=np.intp).reshape(-1, 2)


def parse_target(text: str) -> Target:
    """The target that a description names.

    Parameters
    ----------
    text
        ``checkerboard:COLSxROWS:SQUARE_M`` (inner corners), ``charuco:COLSxROWS:SQUARE_M:MARKER_M:DICT`` (squares),
        ``aprilgrid:COLSxROWS:TAG_M:GAP`` (tags of Kalibr's AprilGrid, gap divided by the tag's side), or
        ``aruco:DICT:SIDE_M`` (single markers). Lengths are metres; the first one may be followed by ``+-`` and how
        well it is known (standard deviation), as in ``checkerboard:9x6:0.025+-0.0001``.

    Raises
    ------
    TargetSpecError
        When the description is not one of these; the message says which field is wrong and what is expected.
    """
    if "+-" in text:
        return _parse_with_sigma(text)
    kind, *fields = (field.strip() for field in text.split(":"))
    kind = kind.lower()
    if kind not in _FORMS:
        raise TargetSpecError(text, Fact("target-kind-unknown", kind=kind))
    wanted = _FORMS[kind].split(":")[1:]
    if len(fields) != len(wanted):
        raise TargetSpecError(text, Fact("target-fields", found=len(fields), kind=kind, wanted=len(wanted)))
    if kind == "checkerboard":
        columns, rows = _parse_size(text, fields[0], least=3)
        return _make_grid(text, "checkerboard", columns, rows, _parse_length(text, "SQUARE_M", fields[1]))
    if kind == "charuco":
        columns, rows = _parse_size(text, fields[0], least=3)
        square_m, marker_m = _parse_length(text, "SQUARE_M", fields[1]), _parse_length(text, "MARKER_M", fields[2])
        if marker_m >= square_m:
            raise TargetSpecError(text, Fact("marker-larger-than-square", marker_m=marker_m, square_m=square_m))
        dictionary = _parse_dictionary(text, fields[3], columns * rows // 2)
        board = _make_grid(text, "charuco", columns, rows, square_m)
        return replace(board, marker_m=marker_m, dictionary=dictionary)
    if kind == "aprilgrid":
        columns, rows = _parse_size(text, fields[0], least=1)
        gap = _parse_number(text, "GAP", fields[2])
        if not 0 < gap <= 1:
            raise TargetSpecError(text, Fact("gap-out-of-range", gap=gap))
        _parse_dictionary(text, APRILGRID_DICTIONARY, columns * rows)
        return _make_aprilgrid(text, columns, rows, _parse_length(text, "TAG_M", fields[1]), gap)
    dictionary = _parse_dictionary(text, fields[0], 1)
    return _make_markers(text, dictionary, _parse_length(text, "SIDE_M", fields[1]))


def _parse_with_sigma(text: str) -> Target:
    """The target of a description that says how well its length is known."""
    before, _, after = text.partition("+-")
    number, colon, rest = after.partition(":")
    target = parse_target(f"{before.strip()}{colon}{rest}")
    sigma_m = _parse_length(text, "what follows +-", number)
    length = before.rpartition(":")[2].strip()
    if float(length) != target.length_m:
        raise TargetSpecError(text, Fact("sigma-of-another-length"))
    if sigma_m > 0.2 * target.length_m:
        raise TargetSpecError(text, Fact("sigma-too-large", sigma_m=sigma_m))
    return replace(target, spec=text, sigma_m=sigma_m)


def _parse_number(spec: str, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise TargetSpecError(spec, Fact("not-a-number-in-target", name=name, text=text)) from None


def _parse_length(spec: str, name: str, text: str) -> float:
    value = _parse_number(spec, name, text)
    if not (np.isfinite(value) and value > 0):
        raise TargetSpecError(spec, Fact("length-not-positive", name=name, text=text))
    if value > _LONGEST_M:
        raise TargetSpecError(spec, Fact("length-in-millimetres", name=name, text=text, value=value))
    return value


def _parse_size(spec: str, text: str, *, least: int) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX](\d+)", text)
    if match is None:
        raise TargetSpecError(spec, Fact("board-size-unreadable", text=text))
    columns, rows = int(match[1]), int(match[2])
    if min(columns, rows) < least or max(columns, rows) > 100:
        raise TargetSpecError(spec, Fact("board-size-out-of-range", text=text, least=least))
    return columns, rows


def _parse_dictionary(spec: str, text: str, markers: int) -> str:
    name = text.upper().removeprefix("DICT_")
    if name not in DICTIONARIES:
        raise TargetSpecError(spec, Fact("dictionary-unknown", text=text, known=tuple(DICTIONARIES)))
    if markers > DICTIONARIES[name]:
        raise TargetSpecError(spec, Fact("dictionary-too-small", markers=markers, name=name, has=DICTIONARIES[name]))
    return name


def _make_grid(spec: str, kind: Literal["checkerboard", "charuco"], columns: int, rows: int, square_m: float) -> Target:
    nx, ny = (columns, rows) if kind == "checkerboard" else (columns - 1, rows - 1)
    row, column = (a.ravel() for a in np.indices((ny, nx)))
    number = np.arange(nx * ny).reshape(ny, nx)
    rotations = [number]
    if kind == "checkerboard":  # markers tell where a ChArUco board begins
        rotations += [np.rot90(number, k) for k in ((1, 2, 3) if nx == ny else (2,))]
    return Target(
        spec=spec,
        kind=kind,
        columns=columns,
        rows=rows,
        length_m=square_m,
        corners_m=_centre(column * square_m, row * square_m),
        part=np.zeros(nx * ny, dtype=np.intp),
        row=row,
        column=column,
        relabelings=np.array([r.ravel() for r in rotations]),
    )


def _make_aprilgrid(spec: str, columns: int, rows: int, tag_m: float, gap: float) -> Target:
    # Kalibr's layout: tag 0 is at the lower left, numbers grow to the right and then upwards; within a tag the
    # corners run lower left, lower right, upper right, upper left.
    tag = np.repeat(np.arange(columns * rows), 4)
    corner = np.tile(np.arange(4), columns * rows)
    right, up = np.isin(corner, (1, 2)), np.isin(corner, (2, 3))
    pitch_m = tag_m * (1 + gap)
    x = (tag % columns) * pitch_m + right * tag_m
    y = (tag // columns) * pitch_m + up * tag_m
    return Target(
        spec=spec,
        kind="aprilgrid",
        columns=columns,
        rows=rows,
        length_m=tag_m,
        gap=gap,
        dictionary=APRILGRID_DICTIONARY,
        corners_m=_centre(x, y),
        part=np.zeros(len(tag), dtype=np.intp),
        row=2 * (tag // columns) + up,
        column=2 * (tag % columns) + right,
        relabelings=np.arange(len(tag))[None],
    )


def _make_markers(spec: str, dictionary: str, side_m: float) -> Target:
    # OpenCV's order: clockwise in the image from the marker's upper left corner
    count = DICTIONARIES[dictionary]
    row, column = np.tile([0, 0, 1, 1], count), np.tile([0, 1, 1, 0], count)
    corners = _centre(column[:4] * side_m, row[:4] * side_m)
    return Target(
        spec=spec,
        kind="aruco",
        length_m=side_m,
        dictionary=dictionary,
        corners_m=np.tile(corners, (count, 1)),
        part=np.repeat(np.arange(count), 4),
        row=row,
        column=column,
        relabelings=np.arange(4 * count)[None],
    )


def _centre(x: NDArray[np.floating], y: NDArray[np.floating]) -> Array:
    xy = np.stack([x, y, np.zeros(len(x))], axis=-1).astype(np.float64)
    return xy - xy.mean(axis=0)
