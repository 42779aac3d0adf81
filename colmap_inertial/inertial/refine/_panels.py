"""Cholesky factor of the states' information, in panels: states coupled over tracks, biases to their neighbours only.

Frames follow each other in groups. Of a state, its first ``wide`` numbers (pose and velocity) are coupled with those of
all frames that see the same points, the others (biases) with the frames before and after alone. Within a group, biases
are eliminated first. So the factor holds no entry for biases of frames farther on: with tracks of tens of frames it
takes a fifth of the products that a band of whole states takes, whose width is that of the longest track everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, Int64Array
from colmap_inertial.inertial.refine.values import N_SEEN, N_STATE, Observations

#: Frames of a group: fewer make products too small for BLAS, more eliminate entries that are zero.
GROUP = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Layout:
    """Order of F frames, and which panels of the information they need.

    Attributes
    ----------
    place
        (F,) of each frame in the order.
    wide
        Numbers of a state that are coupled with frames farther on than the next.
    end
        (K,) for each group, the place after the last one that its frames are coupled with. Places go up to ``size``,
        a multiple of the group; those after the last frame's are of no frame.
    state, group
        Numbers of a state; frames of a group.
    """

    place: Int64Array
    wide: int
    end: Int64Array
    state: int = N_STATE
    group: int = GROUP

    @classmethod
    def of(cls, observations: Observations, frames: int) -> Layout:
        """Order by time, or by Cuthill and McKee's rule where that is narrower, as it is where loops close."""
        from scipy.sparse import coo_array, csr_array
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        ones = np.ones(len(observations.frame), dtype=np.int32)
        shape = (frames, int(observations.point[-1]) + 1)
        sees = csr_array(coo_array((ones, (observations.frame, observations.point)), shape=shape))
        following = np.arange(frames - 1)
        chain = coo_array((np.ones(frames - 1, dtype=np.int32), (following, following + 1)), shape=(frames, frames))
        together = csr_array(sees @ sees.T + chain + chain.T)
        row, column = (index.astype(np.int64) for index in together.nonzero())
        other = np.empty(frames, dtype=np.int64)
        other[reverse_cuthill_mckee(together, symmetric_mode=True)] = np.arange(frames)
        layouts = [cls.make(np.arange(frames), N_SEEN, row, column), cls.make(other, N_STATE, row, column)]
        return min(layouts, key=lambda layout: layout.products)

    @classmethod
    def make(
        cls,
        place: Int64Array,
        wide: int,
        row: Int64Array,
        column: Int64Array,
        *,
        state: int = N_STATE,
        group: int = GROUP,
    ) -> Layout:
        """Layout of frames at places, pairs of which (row, column) are coupled."""
        groups = -(-len(place) // group)
        end = np.minimum(group * np.arange(1, groups + 1) + 1, groups * group)
        np.maximum.at(end, place[column] // group, place[row] + 1)
        return cls(place=place, wide=wide, end=np.maximum.accumulate(end), state=state, group=group)

    @property
    def size(self) -> int:
        """Places."""
        return len(self.end) * self.group

    @property
    def narrow(self) -> int:
        """Numbers of a state that are coupled with the next one alone."""
        return self.state - self.wide

    @cached_property
    def rows(self) -> Int64Array:
        """(K,) rows of each group's wide numbers, its own ones first."""
        return np.asarray(self.wide * (self.end - self.group * np.arange(len(self.end))))

    @property
    def products(self) -> float:
        """Multiplications of a factorisation, about."""
        return float(np.sum(self.state * self.group * (self.rows + self.narrow) ** 2.0))

    @cached_property
    def starts(self) -> tuple[Int64Array, Int64Array, Int64Array]:
        """(K + 1,) where the groups' panels begin: those of wide columns, of narrow ones, and of the next biases."""
        own = self.group * self.wide * self.rows
        before = self.group * self.narrow * (self.group * self.narrow + self.rows)
        across = np.full(len(own), self.narrow * self.group * self.state)
        out, begin = [], 0
        for sizes in (own, before, across):
            out.append(begin + np.concatenate([[0], np.cumsum(sizes)]))
            begin = int(out[-1][-1])
        return out[0], out[1], out[2]

    @property
    def size_bytes(self) -> int:
        """Memory of the panels."""
        return 8 * int(self.starts[2][-1])

    @cached_property
    def offsets(self) -> tuple[Int64Array, Int64Array]:
        """(F,) for places: where their columns begin as :func:`reduce_points` counts, and the end of their rows."""
        places = np.arange(len(self.place))
        group = places // self.group
        first, pitch = group * self.group, self.group * self.wide
        own = self.starts[0]
        return np.asarray(own[group] + self.wide * (places - first - first * pitch)), np.asarray(self.end[group])

    def views(self, values: Array) -> Panels:
        """The panels in (N,) memory."""
        wide, narrow, k = self.group * self.wide, self.group * self.narrow, range(len(self.end))
        own, before, across = self.starts
        return Panels(
            own=[values[own[i] : own[i + 1]].reshape(-1, wide) for i in k],
            before=[values[before[i] : before[i + 1]].reshape(-1, narrow) for i in k] if narrow else [],
            across=[values[across[i] : across[i + 1]].reshape(self.narrow, -1) for i in k] if narrow else [],
        )

    @cached_property
    def entries(self) -> tuple[tuple[Int64Array, Int64Array], tuple[Int64Array, Int64Array], Int64Array]:
        """Where entries of the information stand.

        Returns
        -------
        Positions in the memory, and which entries of (F, s, s) blocks of the frames stand there; the same of
        (F - 1, s, s) blocks of frames (rows) with the ones before (columns); (P s,) positions of the diagonal.
        """
        number = np.arange(self.state)
        places = np.arange(self.size)
        same = self._positions(self.place, self.place)
        following = self._positions(self.place[1:], self.place[:-1])
        diagonal = self._positions(places, places)[:, number, number]
        lower = np.broadcast_to(number[:, None] >= number, same.shape)
        return (
            (same[lower], np.flatnonzero(lower)),
            (following.ravel(), np.arange(following.size)),
            np.asarray(diagonal.ravel()),
        )

    def _positions(self, row: Int64Array, column: Int64Array) -> Int64Array:
        """(N, s, s) positions of entries of states at places (N,) and (N,), of which either may be the later.

        The later number of an entry is its row, the earlier one its column. See :class:`Panels` for which panel has it.
        """
        (row_place, row_number), (place, number) = self._sort_by_elimination(row, column)
        group = place // self.group
        first = group * self.group
        row_is_wide, column_is_wide = row_number < self.wide, number < self.wide
        wide_row, wide_column = self.wide * (row_place - first) + row_number, self.wide * (place - first) + number
        narrow_row = self.narrow * (row_place - first) + row_number - self.wide
        narrow_column = self.narrow * (place - first) + number - self.wide
        own, before, across = (starts[group] for starts in self.starts)
        all_wide, all_narrow = self.group * self.wide, self.group * self.narrow
        in_own = own + wide_row * all_wide + wide_column
        row_before = np.where(row_is_wide, all_narrow + wide_row, narrow_row)
        in_before = before + row_before * all_narrow + narrow_column
        column_across = np.where(column_is_wide, all_narrow + wide_column, narrow_column)
        in_across = across + (row_number - self.wide) * (all_narrow + all_wide) + column_across
        is_own, row_is_in_group = row_is_wide & column_is_wide, row_place < first + self.group
        return np.asarray(np.select([is_own, row_is_wide | row_is_in_group], [in_own, in_before], in_across))

    def _sort_by_elimination(
        self, first: Int64Array, second: Int64Array
    ) -> tuple[tuple[Int64Array, Int64Array], tuple[Int64Array, Int64Array]]:
        """Places and numbers (N, s, s) of all pairs of numbers of two states: of the later number, of the earlier one.

        Groups are eliminated one after the other, and of each its narrow numbers before its wide ones.
        """
        shape = (len(first), self.state, self.state)
        number_a, number_b = (np.broadcast_to(numbers, shape) for numbers in np.indices(shape[1:]))
        place_a, place_b = (np.broadcast_to(places[:, None, None], shape) for places in (first, second))
        turn_a, turn_b = (
            2 * (place // self.group) + (number < self.wide)
            for place, number in ((place_a, number_a), (place_b, number_b))
        )
        b_is_later = (turn_a < turn_b) | ((turn_a == turn_b) & (place_a < place_b))
        later = np.where(b_is_later, place_b, place_a), np.where(b_is_later, number_b, number_a)
        earlier = np.where(b_is_later, place_a, place_b), np.where(b_is_later, number_a, number_b)
        return later, earlier


@dataclass(frozen=True, eq=False, kw_only=True)
class Panels:
    """Panels of K groups.

    Attributes
    ----------
    own
        Columns of a group's wide numbers; rows of these, and of the wide numbers up to the group's end.
    before
        Columns of a group's narrow numbers; rows of these, and of the wide numbers as in ``own``.
    across
        Rows of the narrow numbers of the next group's first frame; columns of the narrow, then of the wide numbers.
    """

    own: list[Array]
    before: list[Array]
    across: list[Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class PanelFactor:
    """Cholesky factor of an information matrix in panels, which :meth:`of` overwrites."""

    layout: Layout
    panels: Panels

    @classmethod
    def of(cls, layout: Layout, values: Array) -> PanelFactor:
        """Factor the lower triangle in the panels' memory, in place.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where it is not positive definite.
        """
        panels = layout.views(values)
        wide, first = layout.group * layout.wide, layout.group * layout.narrow
        earliest = np.searchsorted(layout.end, layout.group * np.arange(len(layout.end)), side="right")
        for k, own in enumerate(panels.own):
            for i in range(int(earliest[k]), k):
                begin = wide * (k - i)
                rest = layout.rows[i] - begin
                _subtract(own[:rest], panels.own[i][begin:])
                if first:
                    _subtract(own[:rest], panels.before[i][first + begin :])
            if first:
                before, across = panels.before[k], panels.across[k]
                if k:
                    _carry_biases(panels, layout, k)
                _factor(before[:first])
                _solve_rows(before[:first], before[first:])
                across[:, :first] = _substitute(before[:first], across[:, :first].T).T
                _subtract(own, before[first:])
                across[:, first:] -= across[:, :first] @ before[first : first + wide].T
            _factor(own[:wide])
            _solve_rows(own[:wide], own[wide:])
            if first:
                across[:, first:] = _substitute(own[:wide], across[:, first:].T).T
        return cls(layout=layout, panels=panels)

    def solve(self, rhs: Array) -> Array:
        """(s F, k) solutions of k right-hand sides, states in the layout's order."""
        layout, panels, sides = self.layout, self.panels, rhs.shape[1]
        wide, first, narrow = layout.group * layout.wide, layout.group * layout.narrow, layout.narrow
        states = np.zeros((layout.size, layout.state, sides))
        states.reshape(-1, sides)[: len(rhs)] = rhs
        x = np.ascontiguousarray(states[:, : layout.wide]).reshape(-1, sides)
        y = np.ascontiguousarray(states[:, layout.wide :]).reshape(-1, sides)
        for k, own in enumerate(panels.own):
            at, until = k * wide, k * wide + layout.rows[k]
            if first:
                before, across, biases = panels.before[k], panels.across[k], y[k * first : (k + 1) * first]
                _substitute(before[:first], biases)
                x[at:until] -= before[first:] @ biases
            _substitute(own[:wide], x[at : at + wide])
            x[at + wide : until] -= own[wide:] @ x[at : at + wide]
            if first and k + 1 < len(panels.own):
                y[(k + 1) * first :][:narrow] -= across[:, :first] @ biases + across[:, first:] @ x[at : at + wide]
        for k in range(len(panels.own) - 1, -1, -1):
            own, at, until = panels.own[k], k * wide, k * wide + layout.rows[k]
            x[at : at + wide] -= own[wide:].T @ x[at + wide : until]
            if first:
                before, across, biases = panels.before[k], panels.across[k], y[k * first : (k + 1) * first]
                if k + 1 < len(panels.own):
                    after = y[(k + 1) * first :][:narrow]
                    x[at : at + wide] -= across[:, first:].T @ after
                    biases -= across[:, :first].T @ after
            _substitute(own[:wide], x[at : at + wide], transposed=True)
            if first:
                biases -= before[first:].T @ x[at:until]
                _substitute(before[:first], biases, transposed=True)
        out = np.concatenate([x.reshape(layout.size, -1, sides), y.reshape(layout.size, -1, sides)], axis=1)
        return np.asarray(out.reshape(-1, sides)[: len(rhs)])

    def marginals(self) -> Array:
        """(F, s, s) the inverse's blocks on the diagonal, in the layout's order (Takahashi's recursion)."""
        layout, panels = self.layout, self.panels
        wide, first, group = layout.group * layout.wide, layout.group * layout.narrow, layout.group
        out = np.empty((len(layout.end), group, layout.state, layout.state))
        # the inverse of what a group is coupled with: wide numbers of later groups, biases of the next frame
        after = np.zeros((layout.narrow, layout.narrow))
        for k in range(len(panels.own) - 1, -1, -1):
            own, later = panels.own[k], layout.rows[k] - wide
            lower, below = np.zeros((first + wide, first + wide)), np.zeros((later + layout.narrow, first + wide))
            lower[first:, first:] = np.tril(own[:wide])
            below[:later, first:] = own[wide:]
            if first:
                before = panels.before[k]
                lower[:first, :first], lower[first:, :first] = np.tril(before[:first]), before[first : first + wide]
                below[:later, :first], below[later:] = before[first + wide :], panels.across[k]
            inverse = _substitute(lower, np.eye(first + wide))
            along = below @ inverse
            # this group's end may lie before that of the next one
            reach = np.concatenate([np.arange(later), np.arange(len(after) - layout.narrow, len(after))])
            inner = after[np.ix_(reach, reach)]
            beside = -inner @ along
            here = inverse.T @ inverse - along.T @ beside
            # rounding would grow from group to group where it is not the same on both sides
            here = 0.5 * (here + here.T)
            blocks = np.zeros((group, layout.state, group, layout.state))
            split = [(slice(first, None), layout.wide, slice(0, layout.wide))]
            split += [(slice(0, first), layout.narrow, slice(layout.wide, None))] if first else []
            for at, many, to in split:
                for other, much, across in split:
                    blocks[:, to, :, across] = here[at, other].reshape(group, many, group, much)
            out[k] = blocks[np.arange(group), :, np.arange(group)]
            pick = np.concatenate([np.arange(first, first + wide), np.arange(layout.narrow)])
            mine = here[np.ix_(pick, pick)]
            size = wide + later + layout.narrow
            after = np.empty((size, size))
            bounds = (slice(0, wide), slice(wide + later, None))
            for a, to in zip((slice(0, wide), slice(wide, None)), bounds, strict=True):
                for b, across in zip((slice(0, wide), slice(wide, None)), bounds, strict=True):
                    after[to, across] = mine[a, b]
            rest = slice(wide, wide + later)
            after[rest, rest] = inner[:later, :later]
            after[rest, bounds[0]], after[rest, bounds[1]] = beside[:later, first:], beside[:later, : layout.narrow]
            after[bounds[0], rest], after[bounds[1], rest] = after[rest, bounds[0]].T, after[rest, bounds[1]].T
        return np.asarray(out.reshape(-1, layout.state, layout.state)[: len(layout.place)])

    def log_determinant(self) -> float:
        """Logarithm of the information's determinant."""
        blocks: list[Any] = [*self.panels.own, *self.panels.before]
        return 2 * float(sum(np.log(np.diagonal(block)).sum() for block in blocks))


def _carry_biases(panels: Panels, layout: Layout, k: int) -> None:
    """Subtract from the first biases of a group what the group before has to do with them."""
    wide, first, narrow = layout.group * layout.wide, layout.group * layout.narrow, layout.narrow
    across, before = panels.across[k - 1], panels.before[k]
    rest = layout.rows[k - 1] - wide
    before[:narrow, :narrow] -= across @ across.T
    before[first : first + rest, :narrow] -= panels.before[k - 1][first + wide :] @ across[:, :first].T
    before[first : first + rest, :narrow] -= panels.own[k - 1][wide:] @ across[:, first:].T


# Rows of C's order are columns of Fortran's, in which BLAS works in place.


def _subtract(out: Array, rows: Array) -> None:
    """Subtract the products of contiguous rows with the first ones of them, as many as there are columns, in place."""
    from scipy.linalg.blas import dgemm

    first = rows[: out.shape[1]]
    if len(first) < out.shape[1]:
        out[:, : len(first)] -= rows @ first.T
        return
    dgemm(-1.0, first.T, rows.T, beta=1.0, c=out.T, trans_a=True, overwrite_c=True)


def _factor(block: Array) -> None:
    """Cholesky factor of a lower triangle, in place; above the diagonal nothing is read or written."""
    from scipy.linalg.lapack import dpotrf

    _, info = dpotrf(block.T, lower=False, clean=False, overwrite_a=True)
    if info:
        raise np.linalg.LinAlgError("not positive definite")


def _solve_rows(lower: Array, rows: Array) -> None:
    """Divide contiguous rows by the transposed factor, in place."""
    from scipy.linalg.blas import dtrsm

    if len(rows):
        dtrsm(1.0, lower.T, rows.T, trans_a=True, overwrite_b=True)


def _substitute(lower: Array, sides: Array, *, transposed: bool = False) -> Array:
    """Solve for right-hand sides with a factor or its transpose, in place where they are contiguous."""
    from scipy.linalg.blas import dtrsm

    return np.asarray(dtrsm(1.0, lower.T, sides.T, side=True, trans_a=transposed, overwrite_b=True)).T
