// Filters along curved paths of blur, in overlapping tiles, of linear light.
#pragma once

#include "path_simd.h"

#include <vector>

struct Tiles {
    int rows, columns;        // of tiles
    int side, hop, before;    // of a tile; between neighbours; how far the first begins before the image
    int samples;              // of a path
    const float *paths;       // (rows, columns, samples, 2)
    const float *spread;      // (rows, columns, 3) variances xx, xy, yy of their chords
    const float *window_in;   // (side,)
    const float *window_out;  // (side,) shares of a tile between others; at the image's border its outer half is ones
};

struct Light {
    int height, width, channels;
    const float *values;
};

// As of `colmap_inertial.imaging.path_filters`.
struct Model {
    float noise_factor, flat_below, fitted_from, fitted_to, least_signal, least_noise;
    const float *noise;  // (channels, 2) variance in the dark, and what it grows by with light
    float data_weight;
    int rounds;  // none is Wiener's filter
    const float *splitting;
};

// result (height, width, channels) = light without the blur.
void filter_along(const Light &light, const Tiles &tiles, const Model &model, float *result, const PathSimd &simd,
                  int threads);

// For every channel and every `every`-th tile of every `every`-th row: mean light, the variance that it shows above a
// frequency where the blur leaves no more than a share, and how many of its frequencies do.
std::vector<float> noise_along(const Light &light, const Tiles &tiles, float above, float share, int every,
                               const PathSimd &simd, int threads);

// Turns of the passes of a transform.
std::vector<float> twiddles_of(int side);
size_t room_of(const Square &square);
