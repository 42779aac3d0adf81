// Directional Wiener filter: one image in, one image out, in its own codes.
#pragma once

#include "wiener_simd.h"

#include <cstdint>

struct Field {
    int ny, nx;           // cells
    const float *extent;  // (ny, nx) blur along the major axis, px
    const float *slope;   // (ny, nx) minor over major component
    const bool *along_y;  // (ny, nx) whether the major axis is y
    const float *fade;    // (ny + 1, nx + 1) share of the result at the corners
};

constexpr int MOST_RADIUS = 8;  // of the smoothing

struct Table {
    int rows, width;       // width: T + 1
    float first, steps;    // row i is for (first + i) / steps px
    const float *weights;  // (rows, width)
    const int32_t *reach;  // (rows,)
    int radius;            // of the smoothing, at most MOST_RADIUS
    const float *smoothing;  // (radius + 1,) weights at the distances 0, 1, ... along rows and columns
};

struct Codec {
    const float *decode;  // linear light of every code
    const float *encode;  // codes of evenly spaced light, encode_steps + 2 entries
    int encode_steps;
    int saturated;  // codes from here on are
};

struct Image {
    int height, width, channels;
};

// Code: uint8_t or uint16_t with a codec; float is linear light already, for which the codec is not read.
// Returns the processor time of decoding and of filtering, of all threads of the process.
struct Seconds {
    double decode, filter;
};
template <class Code>
Seconds deblur(const Code *image, Code *result, Image size, const Field &field, const Table &table, const Codec &codec,
               const Simd &simd, int threads);

// The codes of what another filter made of the image, as linear light: as `deblur`, of which it takes the share of the
// result and the image's own codes where that is zero.
template <class Code>
void blend(const Code *image, const float *light, Code *result, Image size, const Field &field, const Codec &codec,
           const Simd &simd, int threads);

// result (height, width, 3) = linear light of (height, width) luma, whose shares of R - G and B - G are red and blue;
// lines: slopes and offsets of both over luma, each of half the size, rounded up.
void join(const float *luma, const float *lines, Image size, float red, float blue, float *result, const Simd &simd,
          int threads);

// The nearest codes of linear light.
void encode(const float *light, size_t count, uint8_t *result, const Codec &codec, const Simd &simd);
