// What depends on the instruction set: transforms of one tile, and what is done to its spectrum.
#pragma once

#include <stddef.h>

constexpr int MOST_LANES = 16;
// Floats between arrays that are read and written together: at multiples of 4096 bytes they would share a few sets of the
// first-level cache.
constexpr int APART = 80;

// Sizes of what belongs to tiles of one side (a power of two from 32 on). Rows of pixels and of spectra are a little
// longer than they need be, so that columns spread over all sets of the first-level cache.
struct Square {
    int side;
    int pitch;  // of rows of pixels: side + 16
    int half;   // of rows of spectra: side / 2 + 16, of which side / 2 + 1 count and the others are zero
};

// The spectrum of a real tile: row x holds the horizontal frequency x (the second half is negative), its columns the
// vertical frequencies from 0 to side / 2.
struct Spectrum {
    float *re, *im;
};

struct PathSimd {
    const char *name;
    // room: eight times MOST_LANES * side + APART floats, of no content before and after
    void (*forward)(const Square &square, const float *twiddles, const float *tile, Spectrum out, float *room);
    // spoils the spectrum; not normalised. Of the tile, columns from `first` on, twice `count` (a whole tile is 0 and half
    // the side), multiples of MOST_LANES
    void (*inverse)(const Square &square, const float *twiddles, Spectrum in, int first, int count, float *tile,
                    float *room);
    // a row of a tile, added to its columns' sums, too
    void (*take)(int count, const float *from, float *to, float *sums);
    // a tile without its mean, times the window along both sides
    void (*fade)(const Square &square, float mean, const float *window, float *tile);
    // out += weight share (value + mean)
    void (*add)(int count, float weight, float mean, const float *share, const float *value, float *out);
    // cosines and sines of the multiples of a path's angles, as `transfer` takes them; path: `samples` pairs of px;
    // room: four times `samples` doubles
    void (*turns)(const Square &square, int samples, const float *path, double *room, float *cos_x, float *sin_x,
                  float *cos_y, float *sin_y);
    // transfer = mean over k of exp(i (x ax_k + y ay_k)), from (side / 2 + 1) x samples cosines and sines along x and
    // samples rows of `half` cosines and sines along y
    void (*transfer)(const Square &square, int samples, const float *cos_x, const float *sin_x, const float *cos_y,
                     const float *sin_y, Spectrum out);
    // variance of the transfer: (2 pi)^2 f' C f |lean|^2, C of xx, xy, yy, where lean is how the transfer changes with a
    // chord; frequencies: `half` vertical ones
    void (*doubt)(const Square &square, Spectrum lean, const float *frequencies, float xx, float xy, float yy,
                  float *out);
    // with power = |transfer|^2 + doubt, sums of weight |spectrum|^2 power, weight power and band power^2, over
    // frequencies up to `reach` along x and y
    void (*fit)(const Square &square, int reach, Spectrum transfer, const float *doubt, Spectrum spectrum,
                const float *weight, const float *band, double *sums);
    // spectrum = scale conj(transfer) spectrum / (|transfer|^2 + doubt + factor other)
    void (*restore)(size_t count, Spectrum transfer, const float *doubt, const float *other, float factor, float scale,
                    Spectrum spectrum);
    // power = |transfer|^2 + doubt, data = conj(transfer) spectrum
    void (*correlate)(size_t count, Spectrum transfer, const float *doubt, Spectrum spectrum, float *power,
                      Spectrum data);
    // each frequency by the share w = factor other / (factor other + doubt): power = w (power - doubt), data = w data
    void (*weigh)(size_t count, const float *doubt, const float *other, float factor, float *power, Spectrum data);
    // sum of weight |spectrum|^2 and of weight where |transfer|^2 < limit
    void (*quiet)(size_t count, Spectrum transfer, Spectrum spectrum, const float *weight, float limit, double *sums);
    // out = scale (data + factor out) / (power + factor other)
    void (*blend)(size_t count, Spectrum data, const float *power, const float *other, float factor, float scale,
                  Spectrum out);
    // out = adjoint of differences of what is left of the differences of a tile, after shrinking them
    void (*shrink)(const Square &square, const float *tile, float splitting, float threshold, float *out, float *room);
};

extern const PathSimd path_simd_base;
extern const PathSimd path_simd_avx2;
extern const PathSimd path_simd_avx512;
