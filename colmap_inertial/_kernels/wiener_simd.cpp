#include "wiener_simd.h"

#include "each_set.h"

namespace {

#if defined(__AVX512F__)
constexpr int ROWS = 16, CHAINS = 24;  // 16 of 32 registers add up; 17 loads for 32 multiply-adds
#else
constexpr int ROWS = 8, CHAINS = 12;
#endif
constexpr int LANES = VECTOR_BYTES / sizeof(float);

typedef float Vector __attribute__((vector_size(VECTOR_BYTES)));

inline Vector load(const float *at) {
    Vector v;
    memcpy(&v, at, sizeof v);
    // Into a register, once: GCC would rather read memory again for every multiply-add.
#if defined(__AVX512F__)
    __asm__("" : "+v"(v));
#elif defined(__x86_64__)
    __asm__("" : "+x"(v));
#endif
    return v;
}

void place(const float *__restrict lower, const float *__restrict upper, float fraction, float slope, ptrdiff_t stride,
           Taps &taps) {
    const int pitch = int(stride), reach = taps.reach;
    float *__restrict near_weight = taps.near_weight, *__restrict far_weight = taps.far_weight;
    int32_t *__restrict forward = taps.forward, *__restrict backward = taps.backward;
    for (int j = 0; j <= reach; ++j) {
        const float weight = lower[j] + (upper[j] - lower[j]) * fraction;
        const float y = float(j) * slope;
        int row = int(y);
        row -= float(row) > y;
        const float part = y - float(row);
        near_weight[j] = weight - weight * part;
        far_weight[j] = weight * part;
        forward[j] = row * pitch + j;
        backward[j] = -(row + 1) * pitch - j;
    }
}

// LANES x ROWS pixels at once; every row that is loaded serves two rows of the result.
inline void filter_block(const float *source, ptrdiff_t stride, const Taps &taps, float *tile) {
    Vector sum[ROWS];
    {
        const float weight = taps.near_weight[0];
#pragma GCC unroll 16
        for (int r = 0; r < ROWS; ++r) sum[r] = weight * load(source + r * stride);
    }
    for (int j = 1; j <= taps.reach; ++j) {
        const float near_weight = taps.near_weight[j], far_weight = taps.far_weight[j];
        const float *at = source + taps.forward[j];
        sum[0] += near_weight * load(at);
#pragma GCC unroll 16
        for (int r = 1; r < ROWS; ++r) {
            const Vector row = load(at + r * stride);
            sum[r] += near_weight * row;
            sum[r - 1] += far_weight * row;
        }
        sum[ROWS - 1] += far_weight * load(at + ROWS * stride);

        at = source + taps.backward[j];
        sum[0] += far_weight * load(at);
#pragma GCC unroll 16
        for (int r = 1; r < ROWS; ++r) {
            const Vector row = load(at + r * stride);
            sum[r] += far_weight * row;
            sum[r - 1] += near_weight * row;
        }
        sum[ROWS - 1] += near_weight * load(at + ROWS * stride);
    }
#pragma GCC unroll 16
    for (int r = 0; r < ROWS; ++r) memcpy(tile + r * CELL, &sum[r], sizeof(Vector));
}

void filter(const float *source, ptrdiff_t stride, const Taps &taps, float *tile) {
    for (int y = 0; y < CELL; y += ROWS)
        for (int x = 0; x < CELL; x += LANES) filter_block(source + y * stride + x, stride, taps, tile + y * CELL + x);
}

void combine(const float *const *sources, const float *weights, int radius, float *target, int width) {
    int x = 0;
    for (; x + LANES <= width; x += LANES) {
        Vector sum = weights[0] * load(sources[0] + x);
        for (int k = 1; k <= radius; ++k)
            sum += weights[k] * (load(sources[2 * k - 1] + x) + load(sources[2 * k] + x));
        memcpy(target + x, &sum, sizeof sum);
    }
    for (; x < width; ++x) {
        float sum = weights[0] * sources[0][x];
        for (int k = 1; k <= radius; ++k) sum += weights[k] * (sources[2 * k - 1][x] + sources[2 * k][x]);
        target[x] = sum;
    }
}

void index(const float *__restrict values, int count, float scale, float offset, float *__restrict position,
           int32_t *__restrict index) {
    for (int i = 0; i < count; ++i) {
        const float clipped = values[i] < 0.0f ? 0.0f : values[i];
        position[i] = (clipped > 1.0f ? 1.0f : clipped) * scale + offset;
        index[i] = int32_t(position[i]);
    }
}

void join(const float *__restrict luma, const float *const *near, const float *const *far, int half, int width,
          float red, float blue, float *__restrict room, float *__restrict rgb) {
    float *__restrict between = room + 8 * ptrdiff_t(half);
    for (int plane = 0; plane < 4; ++plane) {
        const float *__restrict one = near[plane], *__restrict other = far[plane];
        float *__restrict full = room + 2 * ptrdiff_t(half) * plane;
        for (int i = 0; i < half; ++i) between[i + 1] = 0.75f * one[i] + 0.25f * other[i];
        between[0] = between[1];
        between[half + 1] = between[half];
        for (int i = 0; i < half; ++i) {
            full[2 * i] = 0.75f * between[i + 1] + 0.25f * between[i];
            full[2 * i + 1] = 0.75f * between[i + 1] + 0.25f * between[i + 2];
        }
    }
    for (int x = 0; x < width; ++x) {
        const float *line = room + x;
        const float r = line[0] * luma[x] + line[2 * half], b = line[4 * half] * luma[x] + line[6 * half];
        const float green = luma[x] - red * r - blue * b;
        rgb[3 * x] = green + r;
        rgb[3 * x + 1] = green;
        rgb[3 * x + 2] = green + b;
    }
}

double multiply_adds(int64_t rounds, float *sink) {
    Vector sum[CHAINS], factor = Vector{} + 0.999f, term = Vector{} + 0.001f;
#pragma GCC unroll 24
    for (int i = 0; i < CHAINS; ++i) sum[i] = Vector{} + float(i);
    for (int64_t round = 0; round < rounds; ++round) {
#pragma GCC unroll 24
        for (int i = 0; i < CHAINS; ++i) sum[i] = sum[i] * factor + term;
    }
    Vector total = {};
#pragma GCC unroll 24
    for (int i = 0; i < CHAINS; ++i) total += sum[i];
    memcpy(sink, &total, sizeof(float));
    return double(rounds) * CHAINS * LANES;
}

}  // namespace

extern const Simd JOIN(simd_, SIMD) = {TEXT(SIMD), LANES, place, filter, combine, index, join, multiply_adds};
