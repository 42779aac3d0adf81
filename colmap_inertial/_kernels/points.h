// Points taken out of the normal equations of a bundle adjustment (Schur complement).
#pragma once

#include <cstddef>
#include <cstdint>

// Numbers of a frame that its observations depend on, and those of a state.
constexpr ptrdiff_t FRAME = 9, STATE = 15;

struct Seen {
    ptrdiff_t points;          // P
    ptrdiff_t shared;          // q
    const int64_t *first;      // (P + 1,) observations of each point
    const int64_t *column;     // (M,) of each observation's frame
    const double *by_frame;    // (M, 2, FRAME)
    const double *by_shared;   // (M, 2, q)
    const double *by_point;    // (M, 2, 3)
    const double *residual;    // (M, 2)
    double damping;            // relative, of the points
};

struct Reduced {
    ptrdiff_t pitch;    // of the band: its width plus one
    double *band;       // (n, pitch): entry (j, i - j) is that of row i >= j, column j
    double *border;     // (n, q)
    double *corner;     // (q, q)
    double *rhs;        // (n,)
    double *rhs_shared; // (q,)
    double *inverse;    // (P, 3, 3) of the points' own blocks
    double *pull;       // (P, 3) the points' right-hand sides
};

// Adds to band, border, corner and right-hand sides in the order of the points. False where a pair of frames lies
// outside the band.
bool reduce_points(const Seen &seen, const Reduced &out);
