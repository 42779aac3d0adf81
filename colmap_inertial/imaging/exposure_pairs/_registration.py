"""Registration of a blurred image to a noisy one, by their pixels: reduced, without their finest and coarsest detail.

Noise is as fine as a pixel, blur takes the fine detail of one image alone, and light falls off towards the corners;
what lies between is the same in both. It is compared by its correlation, maximised over homographies by OpenCV's ECC
(G. Evangelidis, E. Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, 2008).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array
from colmap_inertial.imaging._bilinear import interpolate_nodes
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.exposure_pairs._search import OTHER_TURNS_DEG, USUAL_TURNS_DEG, places
from colmap_inertial.imaging.rolling_shutter import grid_nodes, sampling_maps


@dataclass(frozen=True, kw_only=True)
class RegistrationLimits:
    """Limits of the registration of two exposures."""

    #: Longer sides of the reduced images; the last one also judges.
    sides_px: tuple[int, ...] = (120, 240, 480)
    #: Detail that is compared is coarser than this standard deviation, px of the reduced image,
    fine_px: float = 1.5
    #: and finer than this one;
    coarse_px: float = 16.0
    #: of the first size, than this one: there nearly all counts, which tells repetitions of a pattern apart.
    coarsest_px: float = 60.0
    #: Iterations of ECC, at most.
    ecc_rounds: int = 60
    #: Change of its correlation at which it stops.
    ecc_settled: float = 1e-5
    #: The correlation must rise by this for a more general mapping: less also comes of fitting noise.
    worth: float = 0.003
    #: For leaving the gyroscope, by this: a blur that is not even through time has its centre beside mid-exposure, and
    #: drew pixels away from a true shift by 0.6 px for up to 0.007.
    worth_from_gyro: float = 0.01
    #: Farthest that the pixels may move an image's middle, in its longer side,
    farthest: float = 0.35
    #: its corners beyond that,
    farthest_by_turning: float = 0.5
    #: and any part of it from where the gyroscope has it.
    farthest_from_gyro: float = 0.03
    #: So many places are looked at more closely;
    closer_looks: int = 2
    #: none where the correlation is this high already.
    never_better: float = 0.95
    #: Where a smaller share of the long image tells, all of it has to.
    least_telling: float = 0.1
    #: A pixel tells above this.
    tells: float = 0.5
    #: Images show one view where the correlations of their parts, so many along the longer side,
    parts_along: int = 10
    #: are so high in the mean,
    alike: float = 0.3
    #: and so many of its standard deviations above 0. Of 62 simulated pairs, true ones reach .45 and 8.6 at least,
    #: wrong ones .21 and 6.4 at most.
    alike_sigmas: float = 7.0
    #: A part counts where so much of it tells;
    telling_part: float = 0.3
    #: with fewer of them,
    least_parts: int = 8
    #: all together must correlate so well.
    alike_as_a_whole: float = 0.6


_LIMITS = RegistrationLimits()

#: For leaving it altogether: where it makes the images alike, and where it does not.
_WORTH_AGAINST_GYRO = {True: 0.15, False: 0.0}
#: A wall without texture has less detail than this (standard deviation): in the long image, and in the noisy short one.
_FLAT = (0.003, 0.015)
#: OpenCV's MOTION_TRANSLATION.
_SHIFT = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Registered:
    """Positions of the short exposure's content in the long one.

    Attributes
    ----------
    shift_px
        (Gy, Gx, 2) what to add to a pixel of the short exposure, at the nodes of a :class:`BlurField`.
    by_gyro, by_pixels
        What it rests on; nothing where both are false.
    agreement
        Correlation of the images' detail.
    untouched
        What it would be without any shift.
    alike
        Whether the images show one view, or nothing at all.
    """

    shift_px: Array
    by_gyro: bool
    by_pixels: bool
    agreement: float
    untouched: float
    alike: bool = True


def register(
    short: Float32Array, long: Float32Array, clipped: BoolArray, *, start_px: Array | None = None, step_px: int = 16
) -> Registered:
    """Find the shift between two images of about the same brightness.

    Looked for near the gyroscope's shift, near none, and wherever the reduced images correlate best.

    Parameters
    ----------
    short, long
        (H, W) float32, sRGB 0 to 1.
    clipped
        (H, W) pixels of ``long`` that tell nothing.
    start_px
        (Gy, Gx, 2) the shift by the gyroscope, where there is one.
    step_px
        Distance of the nodes.
    """
    height, width = short.shape
    zero = np.zeros((*BlurField.nodes(width, height, step_px), 2))
    sides = [side for side in _LIMITS.sides_px if side <= 1.5 * max(width, height)] or [max(width, height)]
    levels = [_Level.of(short, long, clipped, side, step_px) for side in sides]
    judge = levels[-1]
    none = Registered(shift_px=zero, by_gyro=False, by_pixels=False, agreement=judge.agreement(zero), untouched=0.0)
    best_mapping = none = replace(none, untouched=none.agreement)
    if start_px is not None:
        gyro = np.where(np.isfinite(start_px), start_px, 0.0)
        # the gyroscope is believed unless the images clearly say otherwise
        best_mapping = replace(none, shift_px=gyro, by_gyro=True, agreement=judge.agreement(gyro))
        better = best_mapping if judge.flat() else _refine(best_mapping, np.eye(3), levels)
        if better.agreement >= best_mapping.agreement + _LIMITS.worth_from_gyro:
            best_mapping = better
    if judge.flat():
        return best_mapping
    alike = judge.alike(best_mapping.shift_px)
    worth = 0.0 if start_px is None else _WORTH_AGAINST_GYRO[alike]
    least = judge.score(best_mapping) + worth
    for turns_deg in (USUAL_TURNS_DEG, OTHER_TURNS_DEG):
        if least >= _LIMITS.never_better or (alike and turns_deg is OTHER_TURNS_DEG):
            break
        guesses = _guess_mappings(none, levels, turns_deg)
        refined = [none, *(_refine(none, guess, levels) for guess in guesses)]
        # repeated detail agrees in many places; what is coarser tells them apart
        best = max(refined, key=lambda candidate: judge.score(candidate) + _score_coarsely(levels[0], candidate))
        if (score := judge.score(best)) > least:
            best_mapping, least = best, score
            alike = judge.alike(best_mapping.shift_px)
    return replace(best_mapping, alike=alike)


@dataclass(frozen=True, eq=False)
class _Level:
    """Both images at one size: their detail, and how much of it tells (0 to 1)."""

    short: Float32Array
    long: Float32Array
    tells: Float32Array
    scale: float
    step_px: int

    @classmethod
    def of(cls, short: Float32Array, long: Float32Array, clipped: BoolArray, side_px: int, step_px: int) -> _Level:
        import cv2

        height, width = short.shape
        scale = min(1.0, side_px / max(width, height))
        size = (max(16, round(scale * width)), max(16, round(scale * height)))
        small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (short, long)]
        lost = cv2.resize(clipped.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        # what is clipped spoils as much around it as the detail is fine, by its share: a glint is no window
        tells = np.clip(1 - 2 * cv2.GaussianBlur(lost, (0, 0), _LIMITS.fine_px), 0, 1)
        if tells.mean() < _LIMITS.least_telling:
            # then the edges of what clips are all that there is to see
            tells = np.ones_like(tells)
        sigmas = _LIMITS.fine_px, _LIMITS.coarsest_px if side_px == _LIMITS.sides_px[0] else _LIMITS.coarse_px
        fine, coarse = ([cv2.GaussianBlur(image, (0, 0), sigma) for image in small] for sigma in sigmas)
        short_detail, long_detail = (np.asarray(f - c, dtype=np.float32) for f, c in zip(fine, coarse, strict=True))
        return cls(short_detail, long_detail, np.asarray(tells, dtype=np.float32), size[0] / width, step_px)

    def moved(self, shift_px: Array) -> tuple[Float32Array, Float32Array]:
        """The long image's detail shifted, and how much it tells."""
        import cv2

        height, width = self.short.shape
        map_x, map_y = sampling_maps(self.scale * shift_px, width, height, self.step_px * self.scale)
        moved = cv2.remap(self.long, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        tells = cv2.remap(self.tells, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(moved, dtype=np.float32), np.asarray(tells, dtype=np.float32)

    def agreement(self, shift_px: Array) -> float:
        """Correlation of the details where the long image's tells."""
        moved, tells = self.moved(shift_px)
        return _correlate(self.short, moved, tells)

    def score(self, mapping: Registered) -> float:
        """The agreement times the root of what tells in common: of little, chance agrees more."""
        _, tells = self.moved(mapping.shift_px)
        return mapping.agreement * float(np.sqrt(tells.mean() / max(float(self.tells.mean()), 1e-6)))

    def flat(self) -> bool:
        """Whether there is nothing to align, so that nothing contradicts either."""
        return float(self.long.std()) < _FLAT[0] and float(self.short.std()) < _FLAT[1]

    def alike(self, shift_px: Array) -> bool:
        """Whether details agree all over, in most parts of the image independently."""
        parts = self._correlate_parts(shift_px)
        if len(parts) < _LIMITS.least_parts:
            return self.agreement(shift_px) >= _LIMITS.alike_as_a_whole
        mean, spread = float(parts.mean()), float(parts.std()) / np.sqrt(len(parts))
        return bool(mean >= _LIMITS.alike and mean >= _LIMITS.alike_sigmas * spread)

    def _correlate_parts(self, shift_px: Array) -> Array:
        """Correlations of the squares with enough detail."""
        moved, tells = self.moved(shift_px)
        height, width = self.short.shape
        side = max(16, max(height, width) // _LIMITS.parts_along)
        parts = []
        for top in range(0, height - side + 1, side):
            for left in range(0, width - side + 1, side):
                part = (slice(top, top + side), slice(left, left + side))
                if tells[part].mean() >= _LIMITS.telling_part:
                    parts.append(_correlate(self.short[part], moved[part], tells[part]))
        return np.array(parts)


def _correlate(a: Float32Array, b: Float32Array, weights: Float32Array) -> float:
    """Weighted; 0 where nothing varies."""
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    x, y = (image - float((weights * image).sum()) / total for image in (a, b))
    norm = float(np.sqrt((weights * x * x).sum(dtype=np.float64) * (weights * y * y).sum(dtype=np.float64)))
    return float((weights * x * y).sum(dtype=np.float64)) / norm if norm > 0 else 0.0


def _guess_mappings(start: Registered, levels: list[_Level], turns_deg: Sequence[float]) -> list[Array]:
    """(3, 3) mappings, px of the full images, from the short one to where the long one may lie: the best few."""
    coarse, finer = levels[0], levels[min(1, len(levels) - 1)]
    scale = _scale_about_corner(coarse.scale)
    peaks = places(
        coarse.short,
        np.ones_like(coarse.tells),
        coarse.long,
        coarse.tells,
        farthest=_LIMITS.farthest,
        turns_deg=turns_deg,
    )
    ranked = []
    for guess in (np.eye(3), *(np.linalg.inv(scale) @ place.mapping @ scale for place in peaks)):
        mapping: Array | None = guess
        for level in (coarse, finer):
            mapping = None if mapping is None else _maximise_correlation(level, start, mapping, _SHIFT)
        for candidate in (guess, mapping):
            shift = None if candidate is None else _apply_mapping(candidate, start, finer.step_px)
            if candidate is not None and shift is not None:
                moved = replace(start, shift_px=shift, agreement=finer.agreement(shift))
                ranked.append((finer.score(moved) + _score_coarsely(coarse, moved), candidate))
    ranked.sort(key=lambda pair: -pair[0])
    return [candidate for _, candidate in ranked[: _LIMITS.closer_looks]]


def _score_coarsely(coarse: _Level, mapping: Registered) -> float:
    return coarse.score(replace(mapping, agreement=coarse.agreement(mapping.shift_px)))


def _apply_mapping(mapping: Array, start: Registered, step_px: int) -> Array | None:
    """(Gy, Gx, 2) the start's shift after a mapping; ``None`` where that leads too far."""
    rows, columns = start.shift_px.shape[:2]
    nodes = step_px * grid_nodes(rows, columns)
    moved = np.concatenate([nodes, np.ones((rows, columns, 1))], axis=-1) @ mapping.T
    with np.errstate(divide="ignore", invalid="ignore"):
        target = moved[..., :2] / moved[..., 2:]
    if not np.isfinite(target).all() or (moved[..., 2] <= 0).any():
        return None
    step = target - nodes
    side = step_px * max(rows, columns)
    middle = np.linalg.norm(step[rows // 2, columns // 2])
    reach = np.hypot(step[..., 0], step[..., 1]).max()
    if start.by_gyro and reach > _LIMITS.farthest_from_gyro * side:
        return None
    # a turn takes corners farther than the middle
    if middle > _LIMITS.farthest * side or reach > (_LIMITS.farthest + _LIMITS.farthest_by_turning) * side:
        return None
    return np.asarray(step + interpolate_nodes(start.shift_px, target / step_px))


def _refine(start: Registered, guess: Array, levels: list[_Level]) -> Registered:
    """The best of ever more general mappings, from coarse to fine; the start, where none is better."""
    best = start
    for mapping in _generalise_mapping(start, guess, levels):
        shift = _apply_mapping(mapping, start, levels[-1].step_px)
        if shift is None:
            continue
        agreement = levels[-1].agreement(shift)
        # a more general mapping must be worth it
        if agreement >= best.agreement + _LIMITS.worth:
            best = replace(start, shift_px=shift, by_pixels=True, agreement=agreement)
    return best


def _generalise_mapping(start: Registered, guess: Array, levels: list[_Level]) -> Iterator[Array]:
    """(3, 3) from pixels of the short image to those of the shifted long one: shift, turn, homography."""
    import cv2

    mapping = guess
    # the simplest at every size, from coarse to fine; what is more general only where it can be told
    steps = [(level, _SHIFT) for level in levels]
    steps += [(levels[-1], kind) for kind in (cv2.MOTION_EUCLIDEAN, cv2.MOTION_HOMOGRAPHY)]
    for level, kind in steps:
        general = _maximise_correlation(level, start, mapping, kind)
        if general is None:
            break
        mapping = general
        if level is levels[-1]:
            yield mapping


def _maximise_correlation(level: _Level, start: Registered, mapping: Array, kind: int) -> Array | None:
    """ECC from a mapping, both in px of the full image; ``None`` where it does not converge."""
    import cv2

    moved, weights = level.moved(start.shift_px)
    tells = (weights > _LIMITS.tells).astype(np.uint8)
    scale = _scale_about_corner(level.scale)
    small = scale @ mapping @ np.linalg.inv(scale)
    size = 3 if kind == cv2.MOTION_HOMOGRAPHY else 2
    warp = np.ascontiguousarray((small / small[2, 2])[:size], dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _LIMITS.ecc_rounds, _LIMITS.ecc_settled)
    try:
        _, warp = cv2.findTransformECC(level.short, moved, warp, kind, criteria, tells, 1)
    except cv2.error:
        return None
    full = np.eye(3)
    full[:size] = warp
    return np.asarray(np.linalg.inv(scale) @ full @ scale)


def _scale_about_corner(scale: float) -> Array:
    """Transform from OpenCV's pixels of an image to those of one reduced by area: corners stay, not centres of
    pixels.
    """
    offset = 0.5 * scale - 0.5
    return np.array([[scale, 0, offset], [0, scale, offset], [0, 0, 1.0]])
