"""Evidence of motion blur in an image: does it confirm the blur that the gyroscope predicts?

An image smeared by L pixels along a direction has a spectrum with zeros every 1/L, and therefore a dip in its
cepstrum (the inverse transform of the logarithm of its power spectrum) at that lag, in that direction and in no
other. Tiles of the image are compared at lags relative to the blur predicted for each of them, so that the whole
image, and many images of one recording, add up. The cepstrum of blurred images: Rom, "On the cepstrum of
two-dimensional functions" (IEEE Trans. Information Theory, 1975).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Array, BoolArray, Float32Array, IndexArray, UInt8Array, UInt16Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.tracking import convert_to_grey

#: Lags as factors of the predicted extent, and directions against the predicted one.
FACTORS = np.arange(0.6, 1.5001, 0.05)
DIRECTIONS_RAD = np.radians(np.arange(0.0, 180.0, 15.0))


@dataclass(frozen=True, kw_only=True)
class EvidenceLimits:
    """Settings of the search for evidence of blur, and its weights."""

    #: Side of the smallest tiles.
    smallest_tile_px: int = 64
    #: Tiles are at least this many blur lengths wide.
    tile_blurs: float = 2.9
    #: Images with longer blur are reduced to half their size, a quarter and so on.
    longest_px: float = 44.0
    #: Shorter blur leaves no zero in the spectrum.
    shortest_px: float = 2.5
    #: Tiles with a smaller standard deviation of light (full scale = 1) are flat, and tell nothing.
    least_contrast: float = 0.01
    #: Tiles with a larger share of clipped pixels tell nothing.
    most_clipped: float = 0.1
    #: Standard deviation of the smoothing of the cepstrum.
    smoothing_px: float = 0.8
    #: Power, of a tile's mean square 1, below which noise rules.
    floor: float = 1e-7
    #: Fewer tiles tell nothing.
    fewest_tiles: int = 12
    #: More tiles are thinned out: support grows with the square root of their number, cost with it.
    most_tiles: int = 900
    #: As many serve for the share of the blur that shows.
    few_tiles: int = 200
    #: The share of an image's tiles that are its quiet ones.
    quiet_share: float = 0.05
    #: Times the power of quiet tiles at which a tile has half of its weight: noise varies by so much with light and
    #: JPEG.
    above_quiet: float = 3.0
    #: How steeply weights rise there: weak textures of common images, of tenfold power, weigh nearly all.
    steepness: int = 3
    #: Cycles per pixel between which blur takes power from a direction before noise covers it.
    band_per_px: tuple[float, float] = (0.05, 0.25)
    #: Cycles per pixel between which noise is alone.
    noise_band_per_px: tuple[float, float] = (0.4, 0.5)
    #: The share of a tile's mean fall over all frequencies that is put down to the texture's own direction: textures
    #: differ by +-0.25 (natural logarithm of the power) along any two directions, about alike at all frequencies.
    own_direction: float = 0.8
    #: Zeros of the transfer are no deeper than this (natural logarithm): JPEG, and blur that changes in a tile, fill
    #: them.
    deepest_log: float = -3.0
    #: Of an image counts what stands out of the noise by twice its scatter; neighbours that are alike under the window
    #: make that half as large again.
    scatter: float = 3.0
    #: Paths that leave their chord by more are curves.
    curved_px: float = 0.5
    #: With less, the scatter of the spectra alone (variance 1.6, neighbours alike) puts the share off by .1.
    least_information: float = 400.0


_LIMITS = EvidenceLimits()

_BENT_FACTORS, _BENT_RAD = np.arange(0.7, 1.2001, 0.05), np.radians(np.arange(-30.0, 31.0, 3.0))
#: The extents among which the prediction may be: dips at shorter lags are the texture's own.
_PLAUSIBLE = slice(2, 17)


@dataclass(frozen=True, eq=False, kw_only=True)
class BlurEvidence:
    """Depths of the dips in the cepstra of tiles, summed; evidence of several images adds up.

    Attributes
    ----------
    total, total_square
        (FACTORS, DIRECTIONS_RAD) sums over tiles of the cepstrum at that factor of the predicted blur and that
        direction from it, less its median over all directions; and of the squares.
    mirrored, mirrored_square
        (FACTORS, 1) the same in the direction that a gyroscope with one axis flipped would predict.
    tiles
        How many were summed; weighted ones count as so many of equal weight as tell as much.
    extent_px
        Sum of the lengths of their predicted blur.
    standing
        The same, tiles weighted by how far they stand out of the quiet ones of their image (:func:`_weigh_tiles`).
    """

    total: Array
    total_square: Array
    mirrored: Array
    mirrored_square: Array
    tiles: float
    extent_px: float = 0.0
    standing: BlurEvidence | None = None

    @classmethod
    def nothing(cls) -> BlurEvidence:
        """Evidence of no image."""
        zero = np.zeros((len(FACTORS), len(DIRECTIONS_RAD)))
        return cls(total=zero, total_square=zero, mirrored=zero[:, :1], mirrored_square=zero[:, :1], tiles=0)

    def __add__(self, other: BlurEvidence) -> BlurEvidence:
        summed = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self) if f.name != "standing"}
        parts = [evidence.standing for evidence in (self, other) if evidence.standing is not None]
        return BlurEvidence(**summed, standing=parts[0] + parts[1] if len(parts) == 2 else next(iter(parts), None))

    @property
    def enough(self) -> bool:
        """Whether there are tiles enough to say anything."""
        return self.tiles >= _LIMITS.fewest_tiles

    @cached_property
    def sigmas(self) -> Array:
        """(FACTORS, DIRECTIONS_RAD) depth of the mean dip in its standard deviations: positive is a dip."""
        return self._depth(self.total, self.total_square)

    def _depth(self, total: Array, total_square: Array) -> Array:
        if not self.enough:
            return np.zeros_like(total)
        mean = total / self.tiles
        variance = np.maximum(total_square / self.tiles - mean**2, 1e-12)
        return np.asarray(-mean / np.sqrt(variance / self.tiles))

    @property
    def support(self) -> float:
        """Standard deviations by which the dip shows in the predicted direction, at the extent where it is deepest."""
        return float(self.sigmas[_PLAUSIBLE, 0].max())

    @property
    def extent_factor(self) -> float:
        """The extent in the image as a factor of the predicted one: where the dip is deepest, by a parabola."""
        mean = self.total[_PLAUSIBLE, 0]
        i = int(np.clip(np.argmin(mean), 1, len(mean) - 2))
        before, here, after = mean[i - 1 : i + 2]
        bend = before - 2 * here + after
        shift = 0.0 if bend <= 0 else float(np.clip(0.5 * (before - after) / bend, -1, 1))
        return float(FACTORS[_PLAUSIBLE][i] + shift * (FACTORS[1] - FACTORS[0]))

    @property
    def extent_is_plausible(self) -> bool:
        """Whether the deepest dip lies inside the range of extents rather than at its end."""
        i = int(np.argmin(self.total[:, 0]))
        return _PLAUSIBLE.start <= i < _PLAUSIBLE.stop

    @property
    def mirrored_support(self) -> float:
        """``support`` in the direction that a gyroscope with one axis flipped would predict.

        What textures have of their own, which is upright or level, is the same in both.
        """
        return float(self._depth(self.mirrored, self.mirrored_square)[_PLAUSIBLE].max())


def blur_evidence(image: UInt8Array | UInt16Array, blur: BlurField | BlurPath) -> BlurEvidence:
    """Look for the blur that was predicted.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), sRGB.
    blur
        Predicted, of the image's size. Where a path leaves its chord, lags are those at which its own cepstrum dips.

    Returns
    -------
    Evidence in units of the prediction; of no tile where blur is short, or texture missing, all over.
    """
    path = BlurPath.straight(blur) if isinstance(blur, BlurField) else blur
    spectra = _compute_spectra(image, path, _LIMITS.most_tiles)
    if spectra is None:
        return BlurEvidence.nothing()
    logarithm, vectors, paths = spectra
    cepstra, vectors = _compute_cepstra(logarithm), _find_dips(vectors, paths, logarithm.shape[1])
    values = _sample_lags(cepstra, vectors, DIRECTIONS_RAD)
    level = np.median(values[:, :, 2:-1], axis=2, keepdims=True)
    values -= level
    mirrored = _sample_lags(cepstra, vectors * [1, -1], DIRECTIONS_RAD[:1]) - level
    lengths = np.hypot(vectors[:, 0], vectors[:, 1])
    standing = _sum_tiles(values, mirrored, lengths, _weigh_tiles(logarithm))
    return replace(_sum_tiles(values, mirrored, lengths, np.ones(len(values))), standing=standing)


def _sum_tiles(values: Array, mirrored: Array, lengths_px: Array, weight: Array) -> BlurEvidence:
    """Sums of the depths of tiles, (N, FACTORS, DIRECTIONS_RAD) and (N, FACTORS, 1)."""
    values, mirrored = (weight[:, None, None] * depths for depths in (values, mirrored))
    return BlurEvidence(
        total=values.sum(axis=0),
        total_square=(values**2).sum(axis=0),
        mirrored=mirrored.sum(axis=0),
        mirrored_square=(mirrored**2).sum(axis=0),
        tiles=float(weight.sum()),
        extent_px=float(weight @ lengths_px),
    )


def measure_blur_share(image: UInt8Array | UInt16Array, blur: BlurField | BlurPath) -> float | None:
    """Share of the loss of detail that a blur predicts: 1 where the image is blurred so, 0 where it is sharp.

    At one distance from the origin of a tile's spectrum, blur leaves the directions across it as they were and takes
    power from those along it: ``log((S |K|^2 + n) / (S + n))``, with the path's own transfer K, a 1/f^2 image S as
    strong as the tile's directions across say, and the tile's noise n. What the tiles have is compared with that by
    least squares. So a sky, or what is out of focus, of which noise is all that is left there, predicts no fall and
    does not count.

    Returns
    -------
    About 0 also where an image is blurred otherwise: textures decide then, and tiles are many. ``None`` where there is
    too little to tell.
    """
    inputs = _find_share_inputs(image, blur)
    return None if inputs is None else _fit_share(*inputs)


def measure_blur_shares(
    image: UInt8Array | UInt16Array, blur: BlurField | BlurPath
) -> tuple[float | None, float | None]:
    """`measure_blur_share`, and the share of the blur that a gyroscope with one axis flipped would predict."""
    inputs = _find_share_inputs(image, blur)
    if inputs is None:
        return None, None
    logarithm, vectors, paths, weight = inputs
    return _fit_share(*inputs), _fit_share(logarithm, vectors * [1, -1], paths * [1, -1], weight)


def _find_share_inputs(
    image: UInt8Array | UInt16Array, blur: BlurField | BlurPath
) -> tuple[Float32Array, Array, Array, Array] | None:
    """Log power, chords, paths and weights of some tiles; ``None`` where there are too few to tell."""
    path = BlurPath.straight(blur) if isinstance(blur, BlurField) else blur
    spectra = _compute_spectra(image, path, _LIMITS.few_tiles)
    return None if spectra is None else (*spectra, _weigh_tiles(spectra[0]))


def _fit_share(logarithm: Float32Array, vectors: Array, path_px: Array, weight: Array) -> float | None:
    falls = _measure_falls(logarithm, vectors, path_px)
    seen, expected, seen_mean, expected_mean = (weight * fall for fall in falls)
    information = float((expected - _LIMITS.own_direction * expected_mean).sum())
    if information < _LIMITS.least_information:
        return None
    return float((seen - _LIMITS.own_direction * seen_mean).sum()) / information


def _compute_spectra(
    image: UInt8Array | UInt16Array, path: BlurPath, most_tiles: int
) -> tuple[Float32Array, Array, Array] | None:
    """(N, T, T // 2 + 1) log power of tiles, the (N, 2) chords and the (N, S, 2) paths of their blur; ``None`` where
    there are too few to tell."""
    import cv2

    light = _linearise(image)
    chords = path.field()
    lengths = chords.extent_px()
    long_px = float(np.percentile(lengths, 90))
    reduced = 1
    while long_px / reduced > _LIMITS.longest_px:
        reduced *= 2
    if reduced > 1:
        size = (light.shape[1] // reduced, light.shape[0] // reduced)
        if min(size) == 0:
            return None
        light = np.asarray(
            cv2.resize(light[: size[1] * reduced, : size[0] * reduced], size, interpolation=cv2.INTER_AREA)
        )
    tile = _LIMITS.smallest_tile_px
    while tile < _LIMITS.tile_blurs * long_px / reduced:
        tile *= 2
    height, width = light.shape
    if min(height, width) < tile:
        return None
    windows, starts = _cut_tiles(light, tile, most_tiles)
    middles = [(start + tile / 2) * reduced for start in starts]
    vectors = chords.at(*middles).reshape(-1, 2) / reduced
    extent = np.hypot(vectors[:, 0], vectors[:, 1])
    usable = (extent >= _LIMITS.shortest_px) & (extent * FACTORS[-1] < 0.5 * tile)
    usable &= _hold_texture(windows)
    if usable.sum() < _LIMITS.fewest_tiles:
        return None
    paths = path.at(*middles).reshape(len(vectors), -1, 2)[usable] / reduced
    return _compute_log_power(windows[usable]), vectors[usable], paths


def _cut_tiles(light: Float32Array, tile: int, most_tiles: int) -> tuple[Float32Array, list[IndexArray]]:
    """(N, T, T) tiles that cover an image evenly, and where their rows and columns begin."""
    height, width = light.shape
    step = max(3 * tile // 4, int(np.ceil(np.sqrt(height * width / most_tiles))))
    top, left = (_place_tiles(size, tile, step) for size in (height, width))
    windows = np.lib.stride_tricks.sliding_window_view(light, (tile, tile))[top[:, None], left].reshape(-1, tile, tile)
    return windows, [top, left]


def _hold_texture(windows: Float32Array) -> BoolArray:
    """(N,) which of the tiles are neither flat nor clipped."""
    tiles = windows - windows.mean(axis=(1, 2), keepdims=True)
    clipped = (windows > 0.97).mean(axis=(1, 2)) >= _LIMITS.most_clipped
    least = (_LIMITS.least_contrast * windows.shape[1]) ** 2
    return np.asarray((np.einsum("nij,nij->n", tiles, tiles) > least) & ~clipped)


def _compute_log_power(windows: Float32Array) -> Float32Array:
    """(N, T, T // 2 + 1) log power of tiles under Hann's window."""
    from scipy.fft import rfft2

    tile = windows.shape[1]
    tiles = windows - windows.mean(axis=(1, 2), keepdims=True)
    window = np.hanning(tile).astype(np.float32)
    power = _measure_power(rfft2(tiles * (window[:, None] * window)))
    return np.asarray(np.log(power + _LIMITS.floor * tile**2))


def _weigh_tiles(logarithm: Float32Array) -> Array:
    """(N,) weights of tiles by how far they stand out of the quiet ones of their image.

    A sky holds noise alone, and would hide in the mean what the ground below it shows. Noise cannot be told from weak
    texture by itself (JPEG takes its high frequencies), but where all tiles are alike, all weigh alike. The weights add
    up to the number of equal ones that would tell as much: to the same as their squares.
    """
    tile = logarithm.shape[1]
    radius = np.hypot(np.fft.rfftfreq(tile), np.fft.fftfreq(tile)[:, None])
    power = logarithm[:, (radius > _LIMITS.band_per_px[0]) & (radius < _LIMITS.band_per_px[1])].mean(
        axis=1, dtype=np.float64
    )
    above = np.exp(np.minimum(power - np.quantile(power, _LIMITS.quiet_share), 50.0))
    weight = above**_LIMITS.steepness / (above**_LIMITS.steepness + _LIMITS.above_quiet**_LIMITS.steepness)
    return np.asarray(weight * (weight.sum() / (weight @ weight)))


def _linearise(image: UInt8Array | UInt16Array) -> Float32Array:
    """(H, W) roughly linear light, 0 to 1."""
    import cv2

    grey = convert_to_grey(image)
    codes = np.iinfo(grey.dtype).max
    if grey.dtype == np.uint8:
        return np.asarray(cv2.LUT(grey, ((np.arange(256) / 255) ** 2.2).astype(np.float32)))
    return np.asarray((grey.astype(np.float32) / np.float32(codes)) ** np.float32(2.2))


def _place_tiles(size: int, tile: int, step: int) -> IndexArray:
    """Tiles that cover a side evenly."""
    count = max(1, -(-(size - tile) // step) + 1)
    return np.unique(np.rint(np.linspace(0, size - tile, count)).astype(np.intp))


def _measure_falls(logarithm: Float32Array, vectors: Array, path_px: Array) -> tuple[Array, Array, Array, Array]:
    """(N,) sums over the frequencies of each tile: its fall times the expected one, and the expected one squared; and
    both of the means over frequencies."""
    seen, expected, counts = _compute_falls(logarithm, vectors, path_px)
    frequencies = np.maximum(counts.sum(1), 1)
    return (
        (seen * expected).sum(1),
        (expected**2).sum(1),
        seen.sum(1) * expected.sum(1) / frequencies,
        expected.sum(1) ** 2 / frequencies,
    )


def _compute_falls(logarithm: Float32Array, vectors: Array, path_px: Array) -> tuple[Array, Array, BoolArray]:
    """(N, M) falls of N tiles at their frequencies: as seen, and as expected of a path; and (N, M) which of them count.

    A fall is the log power less its mean over the directions across ``vectors`` at the same distance from the origin.
    """
    tile = logarithm.shape[1]
    reach = int(_LIMITS.band_per_px[1] * tile) + 2
    x, y = np.arange(reach - 1) / tile, np.arange(2 - reach, reach - 1)[:, None] / tile
    radius = np.hypot(x, y)
    band = (radius > _LIMITS.band_per_px[0]) & (radius < _LIMITS.band_per_px[1])
    passed = _leak_window(_compute_transfer(path_px, np.arange(-1, reach) / tile, np.arange(1 - reach, reach) / tile))[
        :, band
    ]
    power = logarithm[:, np.arange(2 - reach, reach - 1) % tile, : reach - 1][:, band].astype(np.float64)
    every = np.hypot(np.fft.rfftfreq(tile), np.fft.fftfreq(tile)[:, None])
    noise = np.exp(logarithm[:, (every > _LIMITS.noise_band_per_px[0]) & (every < _LIMITS.noise_band_per_px[1])]).mean(
        axis=1, dtype=np.float64
    )[:, None]
    turn = np.stack([np.broadcast_to(along, radius.shape)[band] for along in (x, y)]) / radius[band]
    across = np.abs(vectors @ turn) < np.sin(np.pi / 6) * np.hypot(vectors[:, 0], vectors[:, 1])[:, None]
    # the same at all frequencies of one distance from the origin
    ring = np.rint(radius[band] * tile).astype(np.intp)
    at_ring = np.eye(ring.max() + 1)[ring]
    count = across @ at_ring
    level, after = ((((values * across) @ at_ring) / np.maximum(count, 1))[:, ring] for values in (power, passed))
    rise = radius[band] ** 2
    above = (((np.exp(power) - noise) * rise) * across).sum(1) - _LIMITS.scatter * noise[:, 0] * np.sqrt(
        across @ rise**2
    )
    picture = np.maximum(above / (passed * across).sum(1), 0)[:, None] / rise
    counts = ~across & (count[:, ring] > 0)
    expected = np.maximum(np.log((picture * passed + noise) / (picture * after + noise)), _LIMITS.deepest_log) * counts
    return (power - level) * counts, expected, counts


def _compute_transfer(path_px: Array, x: Array, y: Array) -> Float32Array:
    """(N, Y, X) power that (N, S, 2) paths leave at frequencies, cycles per pixel."""
    waves = []
    for i, frequencies in enumerate((x, y)):
        phase = (2 * np.pi * path_px[:, :, i, None] * frequencies).astype(np.float32)
        waves.append(np.cos(phase) + np.complex64(1j) * np.sin(phase))
    return _measure_power(np.swapaxes(waves[1], 1, 2) @ waves[0] / np.float32(path_px.shape[1]))


def _measure_power(spectrum: AnyArray) -> Float32Array:
    """Square of the absolute value."""
    return np.asarray(spectrum.real**2 + spectrum.imag**2)


def _leak_window(power: AnyArray) -> AnyArray:
    """Leakage of a tile under Hann's window: each frequency takes a sixth of either neighbour; without the
    outermost.
    """
    for axis in (1, 2):
        inner = np.moveaxis(power, axis, 0)
        power = np.moveaxis((inner[:-2] + 4 * inner[1:-1] + inner[2:]) / 6, 0, axis)
    return power


def _compute_cepstra(logarithm: Float32Array) -> Float32Array:
    """(N, T, T) of (N, T, T // 2 + 1) log power, smoothed."""
    from scipy.fft import irfft2

    tile = logarithm.shape[1]
    smooth = np.exp(-2 * (np.pi * _LIMITS.smoothing_px * np.fft.fftfreq(tile)) ** 2).astype(np.float32)
    return np.asarray(irfft2(logarithm * smooth[:, None] * smooth[: tile // 2 + 1], s=(tile, tile)))


def _find_dips(vectors: Array, path_px: Array, tile: int) -> Array:
    """(N, 2) lags at which the blur's own cepstrum is deepest: its (N, 2) chord, but of curves.

    Both ends of a path make the zeros of its spectrum. Where it is curved, they bend, and the dip moves and widens.
    """
    bend = path_px - path_px.mean(axis=1, keepdims=True) - middles(path_px.shape[1])[:, None] * vectors[:, None]
    curved = np.flatnonzero(np.hypot(bend[..., 0], bend[..., 1]).max(axis=1) > _LIMITS.curved_px)
    out = vectors.copy()
    if len(curved):
        power = _compute_transfer(path_px[curved], np.asarray(np.fft.rfftfreq(tile)), np.asarray(np.fft.fftfreq(tile)))
        cepstra = _compute_cepstra(np.log(power + np.exp(2 * _LIMITS.deepest_log)).astype(np.float32))
        depth = _sample_lags(cepstra, vectors[curved], _BENT_RAD, _BENT_FACTORS).reshape(len(curved), -1)
        factor, turn = np.unravel_index(depth.argmin(axis=1), (len(_BENT_FACTORS), len(_BENT_RAD)))
        cosine, sine = np.cos(_BENT_RAD[turn]), np.sin(_BENT_RAD[turn])
        x, y = (vectors[curved] * _BENT_FACTORS[factor][:, None]).T
        out[curved] = np.stack([x * cosine - y * sine, x * sine + y * cosine], axis=1)
    return out


def _sample_lags(cepstra: Float32Array, vectors: Array, directions_rad: Array, factors: Array = FACTORS) -> Array:
    """(N, factors, directions) values of (N, T, T) cepstra at the lags around (N, 2) blur vectors; bilinear."""
    tile = cepstra.shape[1]
    cosine, sine = np.cos(directions_rad), np.sin(directions_rad)
    along_x = vectors[:, 0, None] * cosine - vectors[:, 1, None] * sine
    along_y = vectors[:, 0, None] * sine + vectors[:, 1, None] * cosine
    x, y = (factors[None, :, None] * v[:, None, :] for v in (along_x, along_y))
    x0, y0 = np.floor(x), np.floor(y)
    part_x, part_y = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    left, top = x0.astype(np.intp) % tile, y0.astype(np.intp) % tile
    right = (left + 1) % tile
    flat = cepstra.ravel()
    first = np.arange(len(cepstra))[:, None, None] * tile**2
    rows = first + top * tile, first + (top + 1) % tile * tile
    upper, lower = (flat[row + left] * (1 - part_x) + flat[row + right] * part_x for row in rows)
    return np.asarray(upper * (1 - part_y) + lower * part_y, dtype=np.float64)
