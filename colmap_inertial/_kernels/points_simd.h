// Points taken out of the normal equations of a bundle adjustment (Schur complement).
#pragma once

#include <stddef.h>
#include <stdint.h>

// Numbers of a frame that its observations depend on, and those of a state.
constexpr ptrdiff_t FRAME = 9, STATE = 15;

struct Seen {
    ptrdiff_t points;          // P
    ptrdiff_t shared;          // q
    const int64_t *first;      // (P + 1,) observations of each point
    const int64_t *place;      // (M,) of each observation's frame
    const double *by_frame;    // (M, 2, FRAME)
    const double *by_shared;   // (M, 2, q)
    const double *by_point;    // (M, 2, 3)
    const double *residual;    // (M, 2)
    ptrdiff_t wide;            // rows and columns of a frame in the panels
    double damping;            // relative, of the points
};

struct Reduced {
    ptrdiff_t pitch;        // columns of a panel
    double *values;         // the panels' memory
    const int64_t *offset;  // (F,) row i of the frame at place a, column j of that at place b <= a:
                            // offset[b] + (wide a + i) pitch + j
    const int64_t *end;     // (F,) of the frame at place b: the place after the last one that its panel has
    double *border;         // (STATE F, q)
    double *corner;         // (q, q)
    double *rhs;            // (STATE F,)
    double *rhs_shared; // (q,)
    double *inverse;    // (P, 3, 3) of the points' own blocks
    double *pull;       // (P, 3) the points' right-hand sides
};

struct PointsSimd {
    const char *name;
    // Doubles of memory that reduce needs, where a point has so many observations at most.
    size_t (*work)(const Seen &seen, int64_t most);
    // Adds to panels, border, corner and right-hand sides in the order of the points. False where a pair of frames lies
    // outside the panels. Above the diagonal of a frame's own block, the panels have its mirror image.
    bool (*reduce)(const Seen &seen, const Reduced &out, double *work);
};

extern const PointsSimd points_base;
extern const PointsSimd points_avx2;
extern const PointsSimd points_avx512;
