// A chain of states with a few globals, as `ArrowSystem` in inertial/scale/_solver.py has it: what depends on the instruction
// set. Rows of all matrices here are padded to multiples of PAD columns.
#pragma once

#include <stddef.h>

constexpr ptrdiff_t PAD = 8;

constexpr ptrdiff_t padded(ptrdiff_t columns) { return (columns + PAD - 1) / PAD * PAD; }

struct Chain {
    ptrdiff_t states, size, globals, sides;  // K, m, n, q
    const double *diagonal;                  // (K, m, m), of which the lower triangles are read
    const double *below;                     // (K - 1, m, m)
    const double *border;                    // (K, m, n)
    const double *rhs;                       // (K, m, q)
    const double *unit;                      // (K, m), by which rows and columns are multiplied
};

// H = U' U: upper triangles on the diagonal, and full blocks to the right of them.
struct Factor {
    double *diagonal;  // (K, m, padded(m))
    double *right;     // (K, m, padded(m)), of which the last is not used
};

// Derivatives of residuals, `rows` of them for each state or pair of neighbours.
struct Rows {
    ptrdiff_t states, rows, size, globals;
    const double *here;        // (states, rows, size)
    const double *after;       // the same by the next states, or null
    const double *by_globals;  // (states, rows, globals)
};

// Where the products of the derivatives are added, from the first state that takes part; the globals likewise.
struct Sums {
    ptrdiff_t globals;  // in a line of border and corner
    double *diagonal, *below, *border, *corner;
};

struct ArrowSimd {
    const char *name;
    // Doubles of memory, aligned to 64 bytes, that eliminate needs.
    size_t (*work)(const Chain &chain);
    // Factors the chain and subtracts the products of U'^-1 border with U'^-1 [border, rhs] from `products`
    // (n, padded(n + q)), of whose first n columns only the upper triangle is right. False where a pivot is not
    // positive. Writes U'^-1 [border, rhs] (K, m, padded(n + q)) to `forward` where that is not null.
    bool (*eliminate)(const Chain &chain, const Factor &factor, double *products, double *forward, double *work);
    // Solves U' U x = b in place: (K, m, padded(q)), on any boundary; U x = b where it is half done.
    void (*substitute)(const Chain &chain, const Factor &factor, double *x, bool half_done);
    // Doubles of memory, aligned to 64 bytes, that selected_inverse needs.
    size_t (*inverse_work)(const Chain &chain);
    // The blocks of the inverse of U' U where the chain has blocks: on the diagonal (K, m, m), to the right of it
    // (K - 1, m, m).
    void (*selected_inverse)(const Chain &chain, const Factor &factor, double *diagonal, double *right, double *work);
    // Doubles of memory, aligned to 64 bytes, that add_rows needs.
    size_t (*rows_work)(const Rows &rows);
    // Adds the information of residuals: the products of their derivatives.
    void (*add_rows)(const Rows &rows, const Sums &sums, double *work);
};

extern const ArrowSimd arrow_base;
extern const ArrowSimd arrow_avx2;
extern const ArrowSimd arrow_avx512;
