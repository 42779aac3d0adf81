// What depends on the instruction set: the filter of one cell, and the measurement of the processor's peak.
#pragma once

#include <stddef.h>
#include <stdint.h>

constexpr int CELL = 16;  // px, width and height of a cell: the largest patch that is filtered with one set of taps

// The taps of one cell, for steps 0..reach along the major axis. Both directions share the weights: the line crosses
// row `j * slope` between two rows, and at -j it crosses the mirrored pair.
struct Taps {
    int reach;
    float *near_weight;  // of the row nearer to the pixel
    float *far_weight;   // of the row beyond it
    int32_t *forward;    // offset of the near row at +j (the far row is one stride on)
    int32_t *backward;   // offset of the far row at -j (the near row is one stride on)
};

struct Simd {
    const char *name;
    int lanes;
    // Blends two rows of the table of taps and places them along the line.
    void (*place)(const float *lower, const float *upper, float fraction, float slope, ptrdiff_t stride, Taps &taps);
    // tile (CELL x CELL) = sum of taps around `source`, whose rows are `stride` apart.
    void (*filter)(const float *source, ptrdiff_t stride, const Taps &taps, float *tile);
    // target[x] = weights[0] sources[0][x] + sum over 1 <= k <= radius of weights[k] (sources[2k-1][x] + sources[2k][x]).
    void (*combine)(const float *const *sources, const float *weights, int radius, float *target, int width);
    // Clips values to 0..1, scales them, and rounds down.
    void (*index)(const float *values, int count, float scale, float offset, float *position, int32_t *index);
    // A row of colours from luma; R - G and B - G are lines over it. near and far: slopes and offsets of both, one after
    // the other, in the next row of half the size and the one beyond, of `half` pixels. room: 10 half + 4 floats.
    void (*join)(const float *luma, const float *const *near, const float *const *far, int half, int width, float red,
                 float blue, float *room, float *rgb);
    // Runs `rounds` of independent multiply-adds in registers; returns how many (lanes counted singly) it did.
    double (*multiply_adds)(int64_t rounds, float *sink);
};

extern const Simd simd_base;
extern const Simd simd_avx2;
extern const Simd simd_avx512;
