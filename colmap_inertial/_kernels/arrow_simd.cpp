#include "arrow_simd.h"

#include "each_set.h"

#include <math.h>

namespace {

constexpr int ROWS = 6;  // of a tile of a product
#if defined(__AVX512F__)
constexpr int VECTORS = 4;  // 24 of 32 registers add up
#else
constexpr int VECTORS = 2;  // 12 of 16
#endif
constexpr int LANES = VECTOR_BYTES / sizeof(double);
static_assert(PAD % LANES == 0, "rows are whole vectors");

constexpr ptrdiff_t STATES_AT_ONCE = 8;  // whose products are added up together: they stay in the cache

typedef double Vector __attribute__((vector_size(VECTOR_BYTES)));

inline Vector load(const double *at) {
    Vector v;
    memcpy(&v, at, sizeof v);
    return v;
}

// A matrix in memory: entry (i, j) is at[i * row + j * column].
struct Matrix {
    const double *at;
    ptrdiff_t row, column;
};

// c -= a b, for R rows and V vectors of c.
template <int R, int V>
inline void subtract_tile(double *c, ptrdiff_t c_row, const Matrix &a, const double *b, ptrdiff_t b_row,
                          ptrdiff_t inner) {
    Vector sum[R][V] = {};
    for (ptrdiff_t p = 0; p < inner; ++p) {
        Vector line[V];
#pragma GCC unroll 8
        for (int v = 0; v < V; ++v) line[v] = load(b + p * b_row + v * LANES);
#pragma GCC unroll 8
        for (int r = 0; r < R; ++r) {
            const double factor = a.at[r * a.row + p * a.column];
#pragma GCC unroll 8
            for (int v = 0; v < V; ++v) sum[r][v] += factor * line[v];
        }
    }
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r)
#pragma GCC unroll 8
        for (int v = 0; v < V; ++v) {
            const Vector rest = load(c + r * c_row + v * LANES) - sum[r][v];
            memcpy(c + r * c_row + v * LANES, &rest, sizeof rest);
        }
}

template <int R>
inline void subtract_rows(double *c, ptrdiff_t c_row, const Matrix &a, const double *b, ptrdiff_t b_row,
                          ptrdiff_t inner, ptrdiff_t columns) {
    ptrdiff_t j = 0;
    for (; j + VECTORS * LANES <= columns; j += VECTORS * LANES)
        subtract_tile<R, VECTORS>(c + j, c_row, a, b + j, b_row, inner);
    // What is left, in one piece: fewer vectors at a time would wait for the loads of `a`
    const ptrdiff_t left = (columns - j) / LANES;
    if (left == 1) subtract_tile<R, 1>(c + j, c_row, a, b + j, b_row, inner);
    if constexpr (VECTORS > 2) {
        if (left == 2) subtract_tile<R, 2>(c + j, c_row, a, b + j, b_row, inner);
        if (left == 3) subtract_tile<R, 3>(c + j, c_row, a, b + j, b_row, inner);
    }
}

// c -= a b: (rows, inner) times (inner, columns), the latter a multiple of PAD.
void subtract_product(double *c, ptrdiff_t c_row, Matrix a, const double *b, ptrdiff_t b_row, ptrdiff_t rows,
                      ptrdiff_t inner, ptrdiff_t columns) {
    ptrdiff_t i = 0;
    for (; i + ROWS <= rows; i += ROWS, c += ROWS * c_row, a.at += ROWS * a.row)
        subtract_rows<ROWS>(c, c_row, a, b, b_row, inner, columns);
    for (; i < rows; ++i, c += c_row, a.at += a.row) subtract_rows<1>(c, c_row, a, b, b_row, inner, columns);
}

// The upper triangle of a becomes U with a = U' U.
bool factorize(double *a, ptrdiff_t size, ptrdiff_t row) {
    for (ptrdiff_t j = 0; j < size; ++j) {
        double *__restrict pivot = a + j * row;
        if (!(pivot[j] > 0)) return false;
        const double scale = 1 / sqrt(pivot[j]);
        for (ptrdiff_t c = j; c < size; ++c) pivot[c] *= scale;
        for (ptrdiff_t i = j + 1; i < size; ++i) {
            double *__restrict other = a + i * row;
            const double factor = pivot[i];
            for (ptrdiff_t c = i; c < size; ++c) other[c] -= factor * pivot[c];
        }
    }
    return true;
}

// U' x = b in place: (size, columns), the latter a multiple of PAD.
void solve_forward(const double *upper, ptrdiff_t upper_row, double *x, ptrdiff_t x_row, ptrdiff_t size,
                   ptrdiff_t columns) {
    for (ptrdiff_t begin = 0; begin < size; begin += ROWS) {
        const ptrdiff_t end = begin + ROWS < size ? begin + ROWS : size;
        subtract_product(x + begin * x_row, x_row, Matrix{upper + begin, 1, upper_row}, x, x_row, end - begin, begin,
                         columns);
        for (ptrdiff_t i = begin; i < end; ++i) {
            double *__restrict here = x + i * x_row;
            const double scale = 1 / upper[i * upper_row + i];
            for (ptrdiff_t c = 0; c < columns; ++c) here[c] *= scale;
            for (ptrdiff_t k = i + 1; k < end; ++k) {
                double *__restrict other = x + k * x_row;
                const double factor = upper[i * upper_row + k];
                for (ptrdiff_t c = 0; c < columns; ++c) other[c] -= factor * here[c];
            }
        }
    }
}

// U x = b in place.
void solve_backward(const double *upper, ptrdiff_t upper_row, double *x, ptrdiff_t x_row, ptrdiff_t size,
                    ptrdiff_t columns) {
    for (ptrdiff_t i = size - 1; i >= 0; --i) {
        double *here = x + i * x_row;
        const double *line = upper + i * upper_row;
        subtract_product(here, x_row, Matrix{line + i + 1, upper_row, 1}, here + x_row, x_row, 1, size - 1 - i,
                         columns);
        const double scale = 1 / line[i];
        for (ptrdiff_t c = 0; c < columns; ++c) here[c] *= scale;
    }
}

// A state's rows in eliminate: [border, rhs], padded, and the block that ties it to the next state.
ptrdiff_t panel_row(const Chain &chain) { return padded(chain.globals + chain.sides) + padded(chain.size); }

size_t work(const Chain &chain) { return size_t((STATES_AT_ONCE + 1) * chain.size * panel_row(chain)); }

void fill_panel(const Chain &chain, ptrdiff_t k, double *panel) {
    const ptrdiff_t m = chain.size, n = chain.globals, q = chain.sides, row = panel_row(chain);
    const double *unit = chain.unit + k * m;
    memset(panel, 0, size_t(m * row) * sizeof(double));
    for (ptrdiff_t i = 0; i < m; ++i) {
        const double *border = chain.border + (k * m + i) * n, *rhs = chain.rhs + (k * m + i) * q;
        double *line = panel + i * row;
        for (ptrdiff_t j = 0; j < n; ++j) line[j] = border[j] * unit[i];
        for (ptrdiff_t j = 0; j < q; ++j) line[n + j] = rhs[j] * unit[i];
    }
    if (k + 1 == chain.states) return;
    double *right = panel + padded(n + q);
    for (ptrdiff_t j = 0; j < m; ++j) {
        const double *below = chain.below + (k * m + j) * m;
        for (ptrdiff_t i = 0; i < m; ++i) right[i * row + j] = below[i] * (unit[i] * unit[m + j]);
    }
}

bool eliminate(const Chain &chain, const Factor &factor, double *products, double *forward, double *panels) {
    const ptrdiff_t m = chain.size, n = chain.globals, pitch = padded(m), row = panel_row(chain);
    const ptrdiff_t width = padded(n + chain.sides), panel_size = m * row;
    ptrdiff_t waiting = 0;  // panels 1.. whose products are not added yet; panel 0 is of the state before them
    for (ptrdiff_t k = 0; k < chain.states; ++k) {
        double *panel = panels + (waiting + 1) * panel_size, *before = panel - panel_size;
        double *upper = factor.diagonal + k * m * pitch;
        const double *diagonal = chain.diagonal + k * m * m, *unit = chain.unit + k * m;
        memset(upper, 0, size_t(m * pitch) * sizeof(double));
        for (ptrdiff_t j = 0; j < m; ++j)
            for (ptrdiff_t i = 0; i <= j; ++i) upper[i * pitch + j] = diagonal[j * m + i] * (unit[i] * unit[j]);
        fill_panel(chain, k, panel);
        if (k > 0) {
            const Matrix tie{before + width, 1, row};
            subtract_product(upper, pitch, tie, before + width, row, m, m, pitch);
            subtract_product(panel, row, tie, before, row, m, m, width);
        }
        if (!factorize(upper, m, pitch)) return false;
        solve_forward(upper, pitch, panel, row, m, row);
        for (ptrdiff_t i = 0; i < m; ++i)
            memcpy(factor.right + (k * m + i) * pitch, panel + i * row + width, size_t(pitch) * sizeof(double));
        for (ptrdiff_t i = 0; forward && i < m; ++i)
            memcpy(forward + (k * m + i) * width, panel + i * row, size_t(width) * sizeof(double));
        if (++waiting == STATES_AT_ONCE || k + 1 == chain.states) {
            const double *first = panels + panel_size;
            for (ptrdiff_t i = 0; i < n; i += ROWS) {
                const ptrdiff_t from = i / PAD * PAD;
                subtract_product(products + i * width + from, width, Matrix{first + i, 1, row}, first + from, row,
                                 i + ROWS < n ? ROWS : n - i, waiting * m, width - from);
            }
            memcpy(panels, panel, size_t(panel_size) * sizeof(double));
            waiting = 0;
        }
    }
    return true;
}

void substitute(const Chain &chain, const Factor &factor, double *x, bool half_done) {
    const ptrdiff_t m = chain.size, pitch = padded(m), columns = padded(chain.sides), block = m * pitch;
    for (ptrdiff_t k = 0; k < chain.states && !half_done; ++k) {
        double *here = x + k * m * columns;
        if (k > 0)
            subtract_product(here, columns, Matrix{factor.right + (k - 1) * block, 1, pitch}, here - m * columns,
                             columns, m, m, columns);
        solve_forward(factor.diagonal + k * block, pitch, here, columns, m, columns);
    }
    for (ptrdiff_t k = chain.states - 1; k >= 0; --k) {
        double *here = x + k * m * columns;
        if (k + 1 < chain.states)
            subtract_product(here, columns, Matrix{factor.right + k * block, pitch, 1}, here + m * columns, columns, m,
                             m, columns);
        solve_backward(factor.diagonal + k * block, pitch, here, columns, m, columns);
    }
}

size_t inverse_work(const Chain &chain) { return size_t(5 * chain.size * padded(chain.size)); }

// With X = U_k^-1 right_k and the inverse N of the block after: -X N to the right, (U_k' U_k)^-1 + X N X' here (Takahashi,
// Fagan and Chin 1973).
void selected_inverse(const Chain &chain, const Factor &factor, double *diagonal, double *right, double *work) {
    const ptrdiff_t m = chain.size, pitch = padded(m), block = m * pitch;
    double *here = work, *next = work + block, *tie = work + 2 * block, *turned = work + 3 * block;
    double *beside = work + 4 * block;
    for (ptrdiff_t k = chain.states - 1; k >= 0; --k) {
        const double *upper = factor.diagonal + k * block;
        memset(here, 0, size_t(block) * sizeof(double));
        for (ptrdiff_t i = 0; i < m; ++i) here[i * pitch + i] = 1;
        solve_forward(upper, pitch, here, pitch, m, pitch);
        solve_backward(upper, pitch, here, pitch, m, pitch);
        if (k + 1 < chain.states) {
            memcpy(tie, factor.right + k * block, size_t(block) * sizeof(double));
            solve_backward(upper, pitch, tie, pitch, m, pitch);
            memset(beside, 0, size_t(block) * sizeof(double));
            subtract_product(beside, pitch, Matrix{tie, pitch, 1}, next, pitch, m, m, pitch);
            memset(turned, 0, size_t(block) * sizeof(double));
            for (ptrdiff_t i = 0; i < m; ++i)
                for (ptrdiff_t j = 0; j < m; ++j) turned[i * pitch + j] = tie[j * pitch + i];
            subtract_product(here, pitch, Matrix{beside, pitch, 1}, turned, pitch, m, m, pitch);
            for (ptrdiff_t i = 0; i < m; ++i)
                memcpy(right + (k * m + i) * m, beside + i * pitch, size_t(m) * sizeof(double));
        }
        for (ptrdiff_t i = 0; i < m; ++i)
            memcpy(diagonal + (k * m + i) * m, here + i * pitch, size_t(m) * sizeof(double));
        double *swapped = here;
        here = next;
        next = swapped;
    }
}

// to[i * to_row + j] -= from[i * from_row + j]
void subtract(double *__restrict to, ptrdiff_t to_row, const double *__restrict from, ptrdiff_t from_row,
              ptrdiff_t rows, ptrdiff_t columns) {
    for (ptrdiff_t i = 0; i < rows; ++i)
        for (ptrdiff_t j = 0; j < columns; ++j) to[i * to_row + j] -= from[i * from_row + j];
}

// In add_rows, a residual's line: derivatives by the globals, the state and the next one, each padded.
ptrdiff_t line_of(const Rows &rows) { return padded(rows.globals) + 2 * padded(rows.size); }

size_t rows_work(const Rows &rows) {
    const ptrdiff_t g = padded(rows.globals);
    return size_t(STATES_AT_ONCE * rows.rows * line_of(rows) + 2 * rows.size * line_of(rows) + g * g);
}

void add_rows(const Rows &rows, const Sums &sums, double *work) {
    const ptrdiff_t r = rows.rows, m = rows.size, g = rows.globals, n = sums.globals, line = line_of(rows);
    const ptrdiff_t at_here = padded(g), at_after = at_here + padded(m);
    double *const jacobians = work, *const here = jacobians + STATES_AT_ONCE * r * line, *const after = here + m * line;
    double *const corner = after + m * line;
    memset(corner, 0, size_t(at_here * at_here) * sizeof(double));
    for (ptrdiff_t k = 0, waiting = 0; k < rows.states; ++k) {
        double *jacobian = jacobians + waiting * r * line;
        memset(jacobian, 0, size_t(r * line) * sizeof(double));
        for (ptrdiff_t i = 0; i < r; ++i) {
            double *to = jacobian + i * line;
            if (g) memcpy(to, rows.by_globals + (k * r + i) * g, size_t(g) * sizeof(double));
            memcpy(to + at_here, rows.here + (k * r + i) * m, size_t(m) * sizeof(double));
            if (rows.after) memcpy(to + at_after, rows.after + (k * r + i) * m, size_t(m) * sizeof(double));
        }
        memset(here, 0, size_t(2 * m * line) * sizeof(double));
        subtract_product(here, line, Matrix{jacobian + at_here, 1, line}, jacobian, line, m, r, at_after);
        subtract(sums.border + k * m * n, n, here, line, m, g);
        subtract(sums.diagonal + k * m * m, m, here + at_here, line, m, m);
        if (rows.after) {
            subtract_product(after, line, Matrix{jacobian + at_after, 1, line}, jacobian, line, m, r, line);
            subtract(sums.border + (k + 1) * m * n, n, after, line, m, g);
            subtract(sums.below + k * m * m, m, after + at_here, line, m, m);
            subtract(sums.diagonal + (k + 1) * m * m, m, after + at_after, line, m, m);
        }
        if (++waiting == STATES_AT_ONCE || k + 1 == rows.states) {
            for (ptrdiff_t i = 0; i < g; i += ROWS) {
                const ptrdiff_t from = i / PAD * PAD;
                subtract_product(corner + i * at_here + from, at_here, Matrix{jacobians + i, 1, line}, jacobians + from,
                                 line, i + ROWS < g ? ROWS : g - i, waiting * r, at_here - from);
            }
            waiting = 0;
        }
    }
    for (ptrdiff_t i = 0; i < g; ++i)
        for (ptrdiff_t j = 0; j < g; ++j) sums.corner[i * n + j] -= corner[j < i ? j * at_here + i : i * at_here + j];
}

}  // namespace

extern const ArrowSimd JOIN(arrow_, SIMD) = {
    TEXT(SIMD), work, eliminate, substitute, inverse_work, selected_inverse, rows_work, add_rows};
