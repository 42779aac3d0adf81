// The inner loops of matching several apertures, compiled once for each instruction set.
#pragma once

#include <stddef.h>
#include <stdint.h>

// Lanes of the widest vectors; candidates of a pixel are padded to a multiple of it.
constexpr int PADDING = 32;
// What padding costs: above everything that a path can reach, and far enough from the largest number.
constexpr uint16_t BEYOND = 0x3000;

// What one path brings to a pixel: the costs of the pixel before it, their least one, and the penalty for a jump.
struct Step {
    const uint16_t *before;
    uint16_t least;
    uint16_t jump;
};

struct ApertureSimd {
    const char *name;
    // How many of the comparisons of a window's centre with its neighbours differ from the reference's, of those that
    // tell: mismatches[x], for 0 <= x < width. Row r of the window is at rows[r]; each is readable `radius` beyond its
    // ends. `bits` holds two rows of `pitch` bytes (0 or 255) for each neighbour in order: whether it is darker in the
    // reference, and whether by enough to tell. Arrays are readable and writable to `pitch`.
    void (*census)(const uint8_t *const *rows, const uint8_t *bits, ptrdiff_t pitch, int radius, int width,
                   uint8_t *mismatches);
    void (*census_bits)(const uint8_t *const *rows, ptrdiff_t pitch, int radius, int least, int width, uint8_t *bits);
    // blended[x] = (16 - part) upper[x] + part lower[x]
    void (*blend_rows)(const uint8_t *upper, const uint8_t *lower, int part, int width, uint16_t *blended);
    // row[x] = ((16 - part) blended[x] + part blended[x + 1] + 128) / 256
    void (*blend_columns)(const uint16_t *blended, int part, int width, uint8_t *row);
    // sum[x] += mismatches[x], and one more view has seen it
    void (*add)(const uint8_t *mismatches, int width, uint16_t *sum, uint8_t *seen);
    // costs[x] = min(255, (share[seen[x]] sum[x] + 128) / 256), or `unseen` where no view has seen it
    void (*divide)(const uint16_t *sum, const uint8_t *seen, const int32_t *share, int unseen, int width,
                   uint8_t *costs);
    // sum[x] += weight row[x]
    void (*weigh)(const uint8_t *row, int weight, int width, int32_t *sum);
    // costs[x] = min(255, costs[x] + table[min(255, abs(sum[x]) / 256)]) where seen[x] is `views`
    void (*look_up)(const int32_t *sum, const uint8_t *seen, int views, const uint8_t *table, int width,
                    uint8_t *costs);
    // cost[x][d] = costs[d][x]
    void (*turn)(const uint8_t *costs, ptrdiff_t pitch, int candidates, int width, uint8_t *cost);
    // One pixel, several paths: after[p][d] and their least; `total` is what the paths sum up to.
    void (*advance)(const uint16_t *cost, int padded, int small, const Step *steps, int paths, uint16_t *const *after,
                    uint16_t *least, uint16_t *total, int add);
};

extern const ApertureSimd apertures_base;
#if defined(COLMAP_INERTIAL_X86_64)
extern const ApertureSimd apertures_avx2, apertures_avx512;
#endif
