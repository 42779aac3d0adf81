#include "points.h"

#include <algorithm>
#include <vector>

namespace {

// Inverse of a symmetric positive definite matrix; its diagonal grows where it is singular. None of nothing.
void invert(double *v) {
    const double least = 1e-14 * (v[0] + v[4] + v[8]);
    if (!(least > 1e-60)) {
        std::fill(v, v + 9, 0.0);
        return;
    }
    for (int i = 0; i < 3; ++i) v[4 * i] += least;
    const double a = v[0], b = v[1], c = v[2], d = v[4], e = v[5], f = v[8];
    const double A = d * f - e * e, B = c * e - b * f, C = b * e - c * d;
    const double unit = 1 / (a * A + b * B + c * C);
    v[0] = A * unit;
    v[1] = v[3] = B * unit;
    v[2] = v[6] = C * unit;
    v[4] = (a * f - c * c) * unit;
    v[5] = v[7] = (b * c - a * e) * unit;
    v[8] = (a * d - b * b) * unit;
}

}  // namespace

bool reduce_points(const Seen &seen, const Reduced &out) {
    const ptrdiff_t q = seen.shared;
    std::vector<double> with_point, solved, shared(size_t(3 * q)), shared_solved(size_t(3 * q));
    for (ptrdiff_t p = 0; p < seen.points; ++p) {
        const int64_t begin = seen.first[p], count = seen.first[p + 1] - begin;
        double *v = out.inverse + 9 * p, *pull = out.pull + 3 * p;
        std::fill(v, v + 9, 0.0);
        std::fill(pull, pull + 3, 0.0);
        std::fill(shared.begin(), shared.end(), 0.0);
        with_point.assign(size_t(3 * FRAME * count), 0.0);
        solved.resize(size_t(3 * FRAME * count));
        for (int64_t o = 0; o < count; ++o) {
            const double *jp = seen.by_point + 6 * (begin + o), *jf = seen.by_frame + 2 * FRAME * (begin + o);
            const double *js = seen.by_shared + 2 * q * (begin + o), *r = seen.residual + 2 * (begin + o);
            double *w = with_point.data() + 3 * FRAME * o;  // (3, FRAME)
            const int64_t column = seen.column[begin + o];
            for (int row = 0; row < 2; ++row, jp += 3, jf += FRAME, js += q, ++r) {
                for (int k = 0; k < 3; ++k) {
                    for (int l = 0; l < 3; ++l) v[3 * k + l] += jp[k] * jp[l];
                    pull[k] -= jp[k] * *r;
                    for (ptrdiff_t i = 0; i < FRAME; ++i) w[FRAME * k + i] += jp[k] * jf[i];
                    for (ptrdiff_t i = 0; i < q; ++i) shared[size_t(q * k + i)] += jp[k] * js[i];
                }
                for (ptrdiff_t j = 0; j < FRAME; ++j) {
                    double *band = out.band + (column + j) * out.pitch - j;
                    for (ptrdiff_t i = j; i < FRAME; ++i) band[i] += jf[i] * jf[j];
                    double *border = out.border + (column + j) * q;
                    for (ptrdiff_t i = 0; i < q; ++i) border[i] += jf[j] * js[i];
                    out.rhs[column + j] -= jf[j] * *r;
                }
                for (ptrdiff_t i = 0; i < q; ++i) {
                    for (ptrdiff_t j = 0; j < q; ++j) out.corner[q * i + j] += js[i] * js[j];
                    out.rhs_shared[i] -= js[i] * *r;
                }
            }
        }
        for (int k = 0; k < 3; ++k) v[4 * k] *= 1 + seen.damping;
        invert(v);
        for (int64_t o = 0; o < count; ++o) {
            const double *w = with_point.data() + 3 * FRAME * o;
            double *y = solved.data() + 3 * FRAME * o;
            for (ptrdiff_t i = 0; i < FRAME; ++i)
                for (int k = 0; k < 3; ++k)
                    y[FRAME * k + i] = v[3 * k] * w[i] + v[3 * k + 1] * w[FRAME + i] + v[3 * k + 2] * w[2 * FRAME + i];
        }
        for (ptrdiff_t i = 0; i < q; ++i)
            for (int k = 0; k < 3; ++k)
                shared_solved[size_t(q * k + i)] = v[3 * k] * shared[size_t(i)] +
                                                   v[3 * k + 1] * shared[size_t(q + i)] +
                                                   v[3 * k + 2] * shared[size_t(2 * q + i)];
        for (int64_t o = 0; o < count; ++o) {
            const double *y = solved.data() + 3 * FRAME * o;
            const int64_t column = seen.column[begin + o];
            for (int64_t other = 0; other < count; ++other) {
                const int64_t left = seen.column[begin + other];
                if (left > column) continue;
                if (column + FRAME - left > out.pitch) return false;
                const double *w = with_point.data() + 3 * FRAME * other;
                for (ptrdiff_t j = 0; j < FRAME; ++j) {
                    double *band = out.band + (left + j) * out.pitch + (column - left - j);
                    const double a = w[j], b = w[FRAME + j], c = w[2 * FRAME + j];
                    for (ptrdiff_t i = left == column ? j : 0; i < FRAME; ++i)
                        band[i] -= y[i] * a + y[FRAME + i] * b + y[2 * FRAME + i] * c;
                }
            }
            for (ptrdiff_t i = 0; i < FRAME; ++i) {
                double *border = out.border + (column + i) * q;
                for (int k = 0; k < 3; ++k) {
                    const double a = y[FRAME * k + i];
                    for (ptrdiff_t j = 0; j < q; ++j) border[j] -= a * shared[size_t(q * k + j)];
                    out.rhs[column + i] -= a * pull[k];
                }
            }
        }
        for (ptrdiff_t i = 0; i < q; ++i)
            for (int k = 0; k < 3; ++k) {
                const double a = shared_solved[size_t(q * k + i)];
                for (ptrdiff_t j = 0; j < q; ++j) out.corner[q * i + j] -= a * shared[size_t(q * k + j)];
                out.rhs_shared[i] -= a * pull[k];
            }
    }
    return true;
}
