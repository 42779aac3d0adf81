#include "points_simd.h"

#include "each_set.h"

namespace {

// Inverse of a symmetric positive definite matrix; its diagonal grows where it is singular. Zero for a zero matrix.
void invert(double *v) {
    const double least = 1e-14 * (v[0] + v[4] + v[8]);
    if (!(least > 1e-60)) {
        memset(v, 0, 9 * sizeof(double));
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

// Frames from this observation on that follow each other in the order and in one panel.
ptrdiff_t run_of(const Seen &seen, const Reduced &out, int64_t begin, int64_t count) {
    ptrdiff_t run = 1;
    for (; run < count && seen.wide == FRAME; ++run) {
        const int64_t left = seen.place[begin + run - 1], next = seen.place[begin + run];
        if (next != left + 1 || out.offset[next] != out.offset[left] + FRAME) break;
    }
    return run;
}

size_t work(const Seen &seen, int64_t most) { return size_t(6 * FRAME * most + 6 * seen.shared); }

bool reduce_points(const Seen &seen, const Reduced &out, double *work) {
    const ptrdiff_t q = seen.shared;
    double *shared = work, *shared_solved = work + 3 * q;
    for (ptrdiff_t p = 0; p < seen.points; ++p) {
        const int64_t begin = seen.first[p], count = seen.first[p + 1] - begin;
        const ptrdiff_t line = FRAME * count;
        double *with_point = work + 6 * q, *solved = with_point + 3 * line;  // (3, line) each
        double *v = out.inverse + 9 * p, *pull = out.pull + 3 * p;
        memset(v, 0, 9 * sizeof(double));
        memset(pull, 0, 3 * sizeof(double));
        memset(work, 0, size_t(6 * q + 3 * line) * sizeof(double));
        for (int64_t o = 0; o < count; ++o) {
            const double *jp = seen.by_point + 6 * (begin + o), *jf = seen.by_frame + 2 * FRAME * (begin + o);
            const double *js = seen.by_shared + 2 * q * (begin + o), *r = seen.residual + 2 * (begin + o);
            double *w = with_point + FRAME * o;
            const int64_t place = seen.place[begin + o];
            double *own = out.values + out.offset[place] + seen.wide * place * out.pitch;
            double *border = out.border + STATE * place * q, *rhs = out.rhs + STATE * place;
            for (int row = 0; row < 2; ++row, jp += 3, jf += FRAME, js += q, ++r) {
                for (int k = 0; k < 3; ++k) {
                    for (int l = 0; l < 3; ++l) v[3 * k + l] += jp[k] * jp[l];
                    pull[k] -= jp[k] * *r;
                    for (ptrdiff_t i = 0; i < FRAME; ++i) w[line * k + i] += jp[k] * jf[i];
                    INDEPENDENT for (ptrdiff_t i = 0; i < q; ++i) shared[q * k + i] += jp[k] * js[i];
                }
                for (ptrdiff_t i = 0; i < FRAME; ++i) {
                    INDEPENDENT for (ptrdiff_t j = 0; j < FRAME; ++j) own[i * out.pitch + j] += jf[i] * jf[j];
                    INDEPENDENT for (ptrdiff_t j = 0; j < q; ++j) border[i * q + j] += jf[i] * js[j];
                    rhs[i] -= jf[i] * *r;
                }
                for (ptrdiff_t i = 0; i < q; ++i) {
                    INDEPENDENT for (ptrdiff_t j = 0; j < q; ++j) out.corner[q * i + j] += js[i] * js[j];
                    out.rhs_shared[i] -= js[i] * *r;
                }
            }
        }
        for (int k = 0; k < 3; ++k) v[4 * k] *= 1 + seen.damping;
        invert(v);
        const double *w[3] = {with_point, with_point + line, with_point + 2 * line};
        for (int k = 0; k < 3; ++k) {
            double *y = solved + line * k;
            INDEPENDENT for (ptrdiff_t i = 0; i < line; ++i)
                y[i] = v[3 * k] * w[0][i] + v[3 * k + 1] * w[1][i] + v[3 * k + 2] * w[2][i];
            INDEPENDENT for (ptrdiff_t i = 0; i < q; ++i)
                shared_solved[q * k + i] =
                    v[3 * k] * shared[i] + v[3 * k + 1] * shared[q + i] + v[3 * k + 2] * shared[2 * q + i];
        }
        for (int64_t other = 0; other < count;) {
            // all rows of the columns of some frames side by side
            const ptrdiff_t run = run_of(seen, out, begin + other, count - other);
            const int64_t left = seen.place[begin + other];
            for (int64_t o = 0; o < count; ++o) {
                const int64_t place = seen.place[begin + o];
                if (place < left) continue;
                if (place >= out.end[left]) return false;
                const ptrdiff_t columns = FRAME * (place - left + 1 < run ? place - left + 1 : run);
                double *block = out.values + out.offset[left] + seen.wide * place * out.pitch;
                for (ptrdiff_t i = 0; i < FRAME; ++i, block += out.pitch) {
                    const double *y = solved + FRAME * o + i, *from = with_point + FRAME * other;
                    const double a = y[0], b = y[line], c = y[2 * line];
                    INDEPENDENT for (ptrdiff_t j = 0; j < columns; ++j)
                        block[j] -= a * from[j] + b * from[line + j] + c * from[2 * line + j];
                }
            }
            other += run;
        }
        for (int64_t o = 0; o < count; ++o) {
            const int64_t place = seen.place[begin + o];
            double *border = out.border + STATE * place * q, *rhs = out.rhs + STATE * place;
            for (ptrdiff_t i = 0; i < FRAME; ++i, border += q)
                for (int k = 0; k < 3; ++k) {
                    const double a = solved[line * k + FRAME * o + i];
                    INDEPENDENT for (ptrdiff_t j = 0; j < q; ++j) border[j] -= a * shared[q * k + j];
                    rhs[i] -= a * pull[k];
                }
        }
        for (ptrdiff_t i = 0; i < q; ++i)
            for (int k = 0; k < 3; ++k) {
                const double a = shared_solved[q * k + i];
                INDEPENDENT for (ptrdiff_t j = 0; j < q; ++j) out.corner[q * i + j] -= a * shared[q * k + j];
                out.rhs_shared[i] -= a * pull[k];
            }
    }
    return true;
}

}  // namespace

extern const PointsSimd JOIN(points_, SIMD) = {TEXT(SIMD), work, reduce_points};
