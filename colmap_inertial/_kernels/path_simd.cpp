#include "path_simd.h"

#include "each_set.h"

#include <stdint.h>

namespace {

constexpr int LANES = VECTOR_BYTES / sizeof(float);

typedef float Vector __attribute__((vector_size(VECTOR_BYTES)));
typedef int32_t Integers __attribute__((vector_size(VECTOR_BYTES)));
typedef float Four __attribute__((vector_size(16)));

inline Vector load(const float *at) {
    Vector v;
    memcpy(&v, at, sizeof v);
    return v;
}

inline void store(float *at, Vector v) { memcpy(at, &v, sizeof v); }

struct Complex {
    Vector re, im;
};

// Rows of numbers with real and imaginary parts apart.
struct Rows {
    float *re, *im;
    ptrdiff_t stride;
    Complex get(int i) const { return {load(re + i * stride), load(im + i * stride)}; }
    void set(int i, Vector a, Vector b) const {
        store(re + i * stride, a);
        store(im + i * stride, b);
    }
};

inline void put_turned(const Rows &to, int i, Vector re, Vector im, const float *w) {
    to.set(i, w[0] * re - w[1] * im, w[0] * im + w[1] * re);
}

// One pass of Stockham's transform: `n` points are left to be combined, `s` transforms of them lie interleaved.
void four_at_once(const Rows &from, const Rows &to, int n, int s, const float *twiddles) {
    const int m = n / 4;
    for (int p = 0; p < m; ++p) {
        const float *w = twiddles + 6 * p;
        for (int q = 0; q < s; ++q) {
            const Complex a = from.get(q + s * p), b = from.get(q + s * (p + m)), c = from.get(q + s * (p + 2 * m)),
                          d = from.get(q + s * (p + 3 * m));
            const Vector sum_re = a.re + c.re, sum_im = a.im + c.im, less_re = a.re - c.re, less_im = a.im - c.im;
            const Vector other_re = b.re + d.re, other_im = b.im + d.im;
            const Vector turn_re = d.im - b.im, turn_im = b.re - d.re;  // i (b - d)
            const int at = q + s * 4 * p;
            to.set(at, sum_re + other_re, sum_im + other_im);
            put_turned(to, at + s, less_re - turn_re, less_im - turn_im, w);
            put_turned(to, at + 2 * s, sum_re - other_re, sum_im - other_im, w + 2);
            put_turned(to, at + 3 * s, less_re + turn_re, less_im + turn_im, w + 4);
        }
    }
}

// a, b, c, d become their own transform.
inline void transform_four(Complex &a, Complex &b, Complex &c, Complex &d) {
    const Complex sum{a.re + c.re, a.im + c.im}, less{a.re - c.re, a.im - c.im}, other{b.re + d.re, b.im + d.im},
        turn{d.im - b.im, b.re - d.re};  // i (b - d)
    a = {sum.re + other.re, sum.im + other.im};
    b = {less.re - turn.re, less.im - turn.im};
    c = {sum.re - other.re, sum.im - other.im};
    d = {less.re + turn.re, less.im + turn.im};
}

inline Complex turned(const Complex &v, float c, float s) { return {c * v.re - s * v.im, c * v.im + s * v.re}; }

// As `four_at_once`, but half as many passes through memory.
template <bool TURNED>
void sixteen_at_once(const Rows &from, const Rows &to, int n, int s, const float *twiddles) {
    constexpr float C = 0.92387953f, S = 0.38268343f, H = 0.70710678f;
    const int m = n / 16;
    for (int p = 0; p < m; ++p) {
        const float *w = twiddles + 30 * p;
        for (int q = 0; q < s; ++q) {
            Complex v[16];
#pragma GCC unroll 16
            for (int j = 0; j < 16; ++j) v[j] = from.get(q + s * (p + m * j));
#pragma GCC unroll 4
            for (int j = 0; j < 4; ++j) transform_four(v[j], v[j + 4], v[j + 8], v[j + 12]);
            v[5] = turned(v[5], C, -S);
            v[9] = turned(v[9], H, -H);
            v[13] = turned(v[13], S, -C);
            v[6] = turned(v[6], H, -H);
            v[10] = {v[10].im, -v[10].re};
            v[14] = turned(v[14], -H, -H);
            v[7] = turned(v[7], S, -C);
            v[11] = turned(v[11], -H, -H);
            v[15] = turned(v[15], -C, S);
            const int at = q + s * 16 * p;
#pragma GCC unroll 4
            for (int r = 0; r < 4; ++r) {
                Complex *y = v + 4 * r;
                transform_four(y[0], y[1], y[2], y[3]);
#pragma GCC unroll 4
                for (int k = 0; k < 4; ++k) {
                    const int place = r + 4 * k;
                    if (TURNED && place)
                        put_turned(to, at + s * place, y[k].re, y[k].im, w + 2 * (place - 1));
                    else
                        to.set(at + s * place, y[k].re, y[k].im);
                }
            }
        }
    }
}

void two_at_once(const Rows &from, const Rows &to, int s) {
    for (int q = 0; q < s; ++q) {
        const Complex a = from.get(q), b = from.get(q + s);
        to.set(q, a.re + b.re, a.im + b.im);
        to.set(q + s, a.re - b.re, a.im - b.im);
    }
}

// Transforms LANES columns of `side` numbers each. `room`: four times LANES * side + APART floats. Little memory fits the first-level
// cache: where the number of passes is even, what is written in the end serves in between, too.
void transform(int side, const float *twiddles, Rows from, Rows to, float *room) {
    const ptrdiff_t size = ptrdiff_t(side) * LANES + APART;
    int passes = 0;
    for (int n = side; n > 1; n /= n >= 16 ? 16 : n >= 4 ? 4 : 2) ++passes;
    const Rows rooms[2] = {{room, room + size, LANES},
                           passes % 2 ? Rows{room + 2 * size, room + 3 * size, LANES} : to};
    int n = side, s = 1, next = 0;
    while (n > 1) {
        const int radix = n >= 16 ? 16 : n >= 4 ? 4 : 2;
        const Rows target = n == radix ? to : rooms[next];
        if (radix == 2)
            two_at_once(from, target, s);
        else if (radix == 4)
            four_at_once(from, target, n, s, twiddles);
        else if (n == 16)
            sixteen_at_once<false>(from, target, n, s, twiddles);
        else
            sixteen_at_once<true>(from, target, n, s, twiddles);
        twiddles += 2 * (radix - 1) * (n / radix);
        n /= radix;
        s *= radix;
        from = target;
        next = 1 - next;
    }
}

void transpose(const float *from, ptrdiff_t from_pitch, int rows, int columns, float *to, ptrdiff_t to_pitch) {
    for (int i = 0; i < rows; i += 4)
        for (int j = 0; j < columns; j += 4) {
            Four a, b, c, d;
            const float *at = from + i * from_pitch + j;
            memcpy(&a, at, 16);
            memcpy(&b, at + from_pitch, 16);
            memcpy(&c, at + 2 * from_pitch, 16);
            memcpy(&d, at + 3 * from_pitch, 16);
            const Four ab = __builtin_shufflevector(a, b, 0, 4, 1, 5),
                       ab2 = __builtin_shufflevector(a, b, 2, 6, 3, 7),
                       cd = __builtin_shufflevector(c, d, 0, 4, 1, 5),
                       cd2 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
            const Four out[4] = {__builtin_shufflevector(ab, cd, 0, 1, 4, 5),
                                 __builtin_shufflevector(ab, cd, 2, 3, 6, 7),
                                 __builtin_shufflevector(ab2, cd2, 0, 1, 4, 5),
                                 __builtin_shufflevector(ab2, cd2, 2, 3, 6, 7)};
            for (int k = 0; k < 4; ++k) memcpy(to + (j + k) * to_pitch + i, &out[k], 16);
        }
}

// Columns x and x + side / 2 are transformed as one column of complex numbers. Of their spectra, rows 0 and side / 2
// are real and go as real and imaginary part of row 0; the rows after it are those up to side / 2.
void forward(const Square &square, const float *twiddles, const float *tile, Spectrum out, float *room) {
    const int side = square.side, middle = side / 2;
    const ptrdiff_t pitch = square.pitch, half = square.half, size = ptrdiff_t(side) * LANES + APART;
    const Rows column{room + 4 * size, room + 5 * size, LANES};
    float *pixels = const_cast<float *>(tile);
    for (int x = 0; x < middle; x += LANES) {
        transform(side, twiddles, {pixels + x, pixels + x + middle, pitch}, column, room);
        // turned in small squares: what is in between stays in the cache
        for (int k = 0; k < middle; k += LANES) {
            float parts[4][LANES * LANES];
            for (int i = 0; i < LANES; ++i) {
                const Complex a = column.get(k + i), b = column.get(k + i ? side - k - i : middle);
                const bool real = k + i == 0;
                store(parts[0] + i * LANES, real ? a.re : 0.5f * (a.re + b.re));
                store(parts[1] + i * LANES, real ? b.re : 0.5f * (a.im - b.im));
                store(parts[2] + i * LANES, real ? a.im : 0.5f * (a.im + b.im));
                store(parts[3] + i * LANES, real ? b.im : 0.5f * (b.re - a.re));
            }
            const ptrdiff_t at = x * half + k, other = (x + middle) * half + k;
            transpose(parts[0], LANES, LANES, LANES, out.re + at, half);
            transpose(parts[1], LANES, LANES, LANES, out.im + at, half);
            transpose(parts[2], LANES, LANES, LANES, out.re + other, half);
            transpose(parts[3], LANES, LANES, LANES, out.im + other, half);
        }
    }
    for (int k = 0; k < middle; k += LANES)
        transform(side, twiddles, {out.re + k, out.im + k, half}, {out.re + k, out.im + k, half}, room);
    for (int x = 0; x < side; ++x)
        for (int k = middle; k < half; ++k) out.re[x * half + k] = out.im[x * half + k] = 0;
    for (int x = 0; x <= middle; ++x) {
        const ptrdiff_t i = x * half, j = ((side - x) % side) * half;
        const float a_re = out.re[i], a_im = out.im[i], b_re = out.re[j], b_im = out.im[j];
        out.re[i] = out.re[j] = 0.5f * (a_re + b_re);
        out.im[i] = 0.5f * (a_im - b_im);
        out.im[j] = -out.im[i];
        out.re[i + middle] = out.re[j + middle] = 0.5f * (a_im + b_im);
        out.im[i + middle] = 0.5f * (b_re - a_re);
        out.im[j + middle] = -out.im[i + middle];
    }
}

void inverse(const Square &square, const float *twiddles, Spectrum in, int first, int count, float *tile, float *room) {
    const int side = square.side, middle = side / 2;
    const ptrdiff_t pitch = square.pitch, half = square.half, size = ptrdiff_t(side) * LANES + APART;
    const Rows column{room + 4 * size, room + 5 * size, LANES};
    for (int x = 0; x < side; ++x) {
        float *re = in.re + x * half, *im = in.im + x * half;
        const float a_re = re[0], a_im = im[0];
        re[0] = a_re - im[middle];
        im[0] = a_im + re[middle];
    }
    // real and imaginary parts swapped, the transform is the inverse
    for (int k = 0; k < middle; k += LANES)
        transform(side, twiddles, {in.im + k, in.re + k, half}, {in.im + k, in.re + k, half}, room);
    for (int x = first; x < first + count; x += LANES) {
        for (int k = 0; k < middle; k += LANES) {
            float parts[4][LANES * LANES];
            const ptrdiff_t at = x * half + k, other = (x + count) * half + k;
            transpose(in.re + at, half, LANES, LANES, parts[0], LANES);
            transpose(in.im + at, half, LANES, LANES, parts[1], LANES);
            transpose(in.re + other, half, LANES, LANES, parts[2], LANES);
            transpose(in.im + other, half, LANES, LANES, parts[3], LANES);
            for (int i = 0; i < LANES; ++i) {
                const Vector a_re = load(parts[0] + i * LANES), a_im = load(parts[1] + i * LANES),
                             b_re = load(parts[2] + i * LANES), b_im = load(parts[3] + i * LANES);
                if (k + i == 0) {
                    column.set(0, a_re, b_re);
                    column.set(middle, a_im, b_im);
                    continue;
                }
                column.set(k + i, a_re - b_im, a_im + b_re);
                column.set(side - k - i, a_re + b_im, b_re - a_im);
            }
        }
        transform(side, twiddles, {column.im, column.re, LANES}, {tile + x + count, tile + x, pitch}, room);
    }
}

void take(int count, const float *from, float *to, float *sums) {
    for (int x = 0; x < count; x += LANES) {
        const Vector v = load(from + x);
        store(to + x, v);
        store(sums + x, load(sums + x) + v);
    }
}

void fade(const Square &square, float mean, const float *window, float *tile) {
    for (int y = 0; y < square.side; ++y) {
        float *row = tile + y * ptrdiff_t(square.pitch);
        const float weight = window[y];
        for (int x = 0; x < square.side; x += LANES)
            store(row + x, (load(row + x) - mean) * (weight * load(window + x)));
    }
}

void add(int count, float weight, float mean, const float *share, const float *value, float *out) {
    int x = 0;
    for (; x + LANES <= count; x += LANES)
        store(out + x, load(out + x) + weight * load(share + x) * (load(value + x) + mean));
    for (; x < count; ++x) out[x] += weight * share[x] * (value[x] + mean);
}

// Each by turning the one before, in double precision: along x all samples side by side, along y the first ones of a
// sample, then all of these at once.
void turns(const Square &square, int samples, const float *path, double *room, float *cos_x, float *sin_x, float *cos_y,
           float *sin_y) {
    const double turn = 6.283185307179586476925 / square.side;
    double *c = room, *s = c + samples, *re = s + samples, *im = re + samples;
    for (int k = 0; k < samples; ++k) {
        c[k] = __builtin_cos(turn * double(path[2 * k]));
        s[k] = __builtin_sin(turn * double(path[2 * k]));
        re[k] = 1;
        im[k] = 0;
    }
    for (int i = 0; i <= square.side / 2; ++i) {
        float *cosines = cos_x + i * ptrdiff_t(samples), *sines = sin_x + i * ptrdiff_t(samples);
        INDEPENDENT
        for (int k = 0; k < samples; ++k) {
            cosines[k] = float(re[k]);
            sines[k] = float(im[k]);
            const double next = re[k] * c[k] - im[k] * s[k];
            im[k] = re[k] * s[k] + im[k] * c[k];
            re[k] = next;
        }
    }
    for (int k = 0; k < samples; ++k) {
        const double angle = turn * double(path[2 * k + 1]), one_c = __builtin_cos(angle), one_s = __builtin_sin(angle);
        float first_c[LANES], first_s[LANES];
        double x = 1, y = 0;
        for (int i = 0; i < LANES; ++i) {
            first_c[i] = float(x);
            first_s[i] = float(y);
            const double next = x * one_c - y * one_s;
            y = x * one_s + y * one_c;
            x = next;
        }
        const Vector base_c = load(first_c), base_s = load(first_s);
        const double all_c = x, all_s = y;
        x = 1, y = 0;
        float *cosines = cos_y + k * ptrdiff_t(square.half), *sines = sin_y + k * ptrdiff_t(square.half);
        for (int i = 0; i <= square.side / 2; i += LANES) {
            const float a = float(x), b = float(y);
            store(cosines + i, a * base_c - b * base_s);
            store(sines + i, a * base_s + b * base_c);
            const double next = x * all_c - y * all_s;
            y = x * all_s + y * all_c;
            x = next;
        }
    }
}

// Rows x and -x share their sums of products. The highest frequencies have no sign: of a curve, their two halves would not
// agree. They are left out, as is what does not count.
void transfer(const Square &square, int samples, const float *cos_x, const float *sin_x, const float *cos_y,
              const float *sin_y, Spectrum out) {
    const int side = square.side, middle = side / 2;
    const ptrdiff_t half = square.half;
    const float share = 1.0f / float(samples);
    for (int k = 0; k < middle; k += LANES)
        for (int x = 0; x < middle; x += 2) {
            Vector cc[2] = {}, ss[2] = {}, cs[2] = {}, sc[2] = {};
            const float *cosines[2] = {cos_x + x * ptrdiff_t(samples), cos_x + (x + 1) * ptrdiff_t(samples)};
            const float *sines[2] = {sin_x + x * ptrdiff_t(samples), sin_x + (x + 1) * ptrdiff_t(samples)};
            for (int i = 0; i < samples; ++i) {
                const Vector c = load(cos_y + i * half + k), s = load(sin_y + i * half + k);
#pragma GCC unroll 2
                for (int r = 0; r < 2; ++r) {
                    cc[r] += cosines[r][i] * c;
                    ss[r] += sines[r][i] * s;
                    cs[r] += cosines[r][i] * s;
                    sc[r] += sines[r][i] * c;
                }
            }
            for (int r = 0; r < 2; ++r) {
                const int row = x + r;
                store(out.re + row * half + k, share * (cc[r] - ss[r]));
                store(out.im + row * half + k, share * (cs[r] + sc[r]));
                if (row == 0) continue;
                store(out.re + (side - row) * half + k, share * (cc[r] + ss[r]));
                store(out.im + (side - row) * half + k, share * (cs[r] - sc[r]));
            }
        }
    for (int x = 0; x < side; ++x)
        for (int k = x == middle ? 0 : middle; k < half; ++k) out.re[x * half + k] = out.im[x * half + k] = 0;
}

inline double total(Vector v) {
    double sum = 0;
    for (int i = 0; i < LANES; ++i) sum += double(v[i]);
    return sum;
}

// Sums of a row at a time: single precision would lose digits over a whole tile.
constexpr size_t SUMMED = 1024;

void doubt(const Square &square, Spectrum lean, const float *frequencies, float xx, float xy, float yy, float *out) {
    constexpr float TURN_SQUARED = 39.4784176f;
    const int side = square.side;
    const ptrdiff_t half = square.half;
    for (int x = 0; x < side; ++x) {
        const float fx = float(x <= side / 2 ? x : x - side) / float(side);
        for (ptrdiff_t y = 0; y < half; y += LANES) {
            const ptrdiff_t at = x * half + y;
            const Vector re = load(lean.re + at), im = load(lean.im + at), fy = load(frequencies + y);
            const Vector along = xx * fx * fx + fy * (2.0f * xy * fx + yy * fy);
            store(out + at, TURN_SQUARED * along * (re * re + im * im));
        }
    }
}

void fit(const Square &square, int reach, Spectrum transfer, const float *doubt, Spectrum spectrum, const float *weight,
         const float *band, double *sums) {
    const int side = square.side;
    const ptrdiff_t half = square.half;
    sums[0] = sums[1] = sums[2] = 0;
    for (int x = 0; x < side; ++x) {
        if (x > reach && x < side - reach) continue;
        Vector seen = {}, once = {}, twice = {};
        for (ptrdiff_t i = x * half; i <= x * half + reach; i += LANES) {
            const Vector k_re = load(transfer.re + i), k_im = load(transfer.im + i), g_re = load(spectrum.re + i),
                         g_im = load(spectrum.im + i), w = load(weight + i);
            const Vector p = k_re * k_re + k_im * k_im + load(doubt + i);
            seen += w * p * (g_re * g_re + g_im * g_im);
            once += w * p;
            twice += load(band + i) * p * p;
        }
        sums[0] += total(seen);
        sums[1] += total(once);
        sums[2] += total(twice);
    }
}

void restore(size_t count, Spectrum transfer, const float *doubt, const float *other, float factor, float scale,
             Spectrum spectrum) {
    for (size_t i = 0; i < count; i += LANES) {
        const Vector k_re = load(transfer.re + i), k_im = load(transfer.im + i), g_re = load(spectrum.re + i),
                     g_im = load(spectrum.im + i);
        const Vector share = scale / (k_re * k_re + k_im * k_im + load(doubt + i) + factor * load(other + i));
        store(spectrum.re + i, share * (k_re * g_re + k_im * g_im));
        store(spectrum.im + i, share * (k_re * g_im - k_im * g_re));
    }
}

void correlate(size_t count, Spectrum transfer, const float *doubt, Spectrum spectrum, float *power, Spectrum data) {
    for (size_t i = 0; i < count; i += LANES) {
        const Vector k_re = load(transfer.re + i), k_im = load(transfer.im + i), g_re = load(spectrum.re + i),
                     g_im = load(spectrum.im + i);
        store(power + i, k_re * k_re + k_im * k_im + load(doubt + i));
        store(data.re + i, k_re * g_re + k_im * g_im);
        store(data.im + i, k_re * g_im - k_im * g_re);
    }
}

void weigh(size_t count, const float *doubt, const float *other, float factor, float *power, Spectrum data) {
    for (size_t i = 0; i < count; i += LANES) {
        const Vector d = load(doubt + i), certain = factor * load(other + i), share = certain / (certain + d);
        store(power + i, share * (load(power + i) - d));
        store(data.re + i, share * load(data.re + i));
        store(data.im + i, share * load(data.im + i));
    }
}

void quiet(size_t count, Spectrum transfer, Spectrum spectrum, const float *weight, float limit, double *sums) {
    sums[0] = sums[1] = 0;
    for (size_t first = 0; first < count; first += SUMMED) {
        Vector seen = {}, times = {};
        const size_t end = first + SUMMED < count ? first + SUMMED : count;
        for (size_t i = first; i < end; i += LANES) {
            const Vector k_re = load(transfer.re + i), k_im = load(transfer.im + i), g_re = load(spectrum.re + i),
                         g_im = load(spectrum.im + i);
            const Vector w = k_re * k_re + k_im * k_im < limit ? load(weight + i) : Vector{};
            seen += w * (g_re * g_re + g_im * g_im);
            times += w;
        }
        sums[0] += total(seen);
        sums[1] += total(times);
    }
}

void blend(size_t count, Spectrum data, const float *power, const float *other, float factor, float scale,
           Spectrum out) {
    for (size_t i = 0; i < count; i += LANES) {
        const Vector share = scale / (load(power + i) + factor * load(other + i));
        store(out.re + i, share * (load(data.re + i) + factor * load(out.re + i)));
        store(out.im + i, share * (load(data.im + i) + factor * load(out.im + i)));
    }
}

inline Vector one_over_cube_root(Vector v) {
    Integers bits;
    memcpy(&bits, &v, sizeof bits);
    const Vector third = __builtin_convertvector(bits, Vector) * (1.0f / 3.0f);
    bits = 0x54a2fa8c - __builtin_convertvector(third, Integers);
    Vector root;
    memcpy(&root, &bits, sizeof root);
    for (int round = 0; round < 2; ++round) root = root * (4.0f / 3.0f - (1.0f / 3.0f) * v * root * root * root);
    return root;
}

inline bool any(Integers lanes) {
    int64_t parts[LANES / 2];
    memcpy(parts, &lanes, sizeof parts);
    int64_t found = 0;
    for (int i = 0; i < LANES / 2; ++i) found |= parts[i];
    return found != 0;
}

// What minimises |w|^(2/3) + splitting / 2 (w - gradient)^2, by three rounds.
inline Vector shrunk(Vector gradient, float step, float threshold) {
    const Vector zero = {}, size = gradient < zero ? -gradient : gradient;
    if (!any(size >= threshold)) return zero;
    Vector w = size;
    for (int round = 0; round < 3; ++round) {
        const Vector least = zero + 1e-9f;
        w = size - step * one_over_cube_root(w < least ? least : w);
        w = w < zero ? zero : w;
    }
    w = size < threshold ? zero : w;
    return gradient < zero ? -w : w;
}

void shrink(const Square &square, const float *tile, float splitting, float threshold, float *out, float *room) {
    const int side = square.side;
    const ptrdiff_t pitch = square.pitch;
    const float step = 2.0f / 3.0f / splitting;
    float *along = room + MOST_LANES, *above = along + pitch + MOST_LANES, *first = above + pitch,
          *padded = first + pitch + MOST_LANES;
    auto down = [&](int y, float *to) {
        const float *row = tile + y * pitch, *next = tile + ((y + 1) % side) * pitch;
        for (int x = 0; x < side; x += LANES) store(to + x, shrunk(load(next + x) - load(row + x), step, threshold));
    };
    down(side - 1, above);  // what the first row takes from the last one
    memcpy(first, above, sizeof(float) * size_t(side));
    for (int y = 0; y < side; ++y) {
        const float *row = tile + y * pitch;
        memcpy(padded, row, sizeof(float) * size_t(side));
        padded[side] = row[0];
        for (int x = 0; x < side; x += LANES)
            store(along + x, shrunk(load(padded + x + 1) - load(padded + x), step, threshold));
        along[-1] = along[side - 1];
        for (int x = 0; x < side; x += LANES)
            store(out + y * pitch + x, load(along + x - 1) - load(along + x) + load(above + x));
        if (y < side - 1)
            down(y, above);
        else
            memcpy(above, first, sizeof(float) * size_t(side));
        for (int x = 0; x < side; x += LANES)
            store(out + y * pitch + x, load(out + y * pitch + x) - load(above + x));
    }
}

}  // namespace

extern const PathSimd JOIN(path_simd_, SIMD) = {TEXT(SIMD), forward,   inverse, take,  fade,  add,    turns, transfer,
                                                doubt,      fit,       restore, correlate, weigh, quiet, blend, shrink};
