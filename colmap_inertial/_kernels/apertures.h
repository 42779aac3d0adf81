// Matching costs over several views, and semi-global matching.
#pragma once

#include "apertures_simd.h"

// Sides of the problem: image, candidate disparities, other views.
struct Sides {
    int height, width, candidates;
    int views, view_height, view_width;
};

// Everything that costs are made from; arrays in C order. `columns` (views, candidates, width) and `rows` (views,
// candidates, height) are where a pixel of the reference lies in a view, in sixteenths of a pixel.
struct CostInput {
    Sides sides;
    const uint8_t *reference;  // (height, width)
    const uint8_t *views;      // (views, view_height, view_width)
    const int32_t *columns, *rows;
    int radius;             // of the census window
    int least;              // difference of codes in the reference below which a comparison does not tell
    const uint8_t *tables;  // (views, 256, 256) cost by codes of reference and view, or null: census
    const int32_t *share;   // (views + 1): times 1/256, by how many views see the pixel
    int unseen;             // cost where no view does
    const int32_t *blend;   // (views + 2): weights of reference and views in 1/256, and a constant; or null
    const uint8_t *blend_table;  // (256): what a residual of the blend costs, where all views see the pixel
    const int32_t *shown;  // (views, view_height, 2): from and up to which column a row shows something, or null: all of it
};

// cost (height, width, candidates)
void matching_cost(const CostInput &input, const ApertureSimd &simd, int threads, uint8_t *cost);

// total (height, width, padded): sums over eight paths; padded is `candidates` up to a multiple of PADDING.
void semi_global(const Sides &sides, const uint8_t *cost, const uint8_t *guide, int small, const uint16_t *jump,
                 const ApertureSimd &simd, int threads, uint16_t *total);

// The least total of each pixel, its candidate, and where a parabola through it and its neighbours is least, from -1/2
// to 1/2 of a candidate aside.
void winners(const Sides &sides, const uint16_t *total, int threads, uint16_t *least, uint16_t *index, float *aside);

// How views see what the reference sees: bits (views, height, width). 1: nothing with a disparity larger by more than
// `tolerance` lies before it. 2: of all that lies on the same pixel of the view, what has the least total is within
// `tolerance`. A pixel (x, y) of disparity d lies in view k, whose pixels are the reference's, at
// (x - cx - d ratios[k][0], y - cy - d ratios[k][1]) / (1 - d ratios[k][2]) + (cx, cy).
void visibility(const Sides &sides, const float *disparity, const uint16_t *least, const double *ratios, double cx,
                double cy, float tolerance, int threads, uint8_t *bits);
