#include "apertures_simd.h"

#include "each_set.h"

#if defined(__SSE4_1__)
#include <smmintrin.h>
#endif

namespace {

#if defined(__AVX512BW__)
constexpr int BYTES = 64;
#elif defined(__AVX2__)
constexpr int BYTES = 32;
#else
constexpr int BYTES = 16;
#endif
constexpr int WORDS = BYTES / 2;
static_assert(PADDING % WORDS == 0, "candidates must fill vectors");

typedef uint8_t Octets __attribute__((vector_size(BYTES)));
typedef uint16_t Words __attribute__((vector_size(BYTES)));

template <class Vector, class Item>
inline Vector load(const Item *at) {
    Vector v;
    memcpy(&v, at, sizeof v);
    return v;
}

inline Words smaller(Words a, Words b) { return a < b ? a : b; }

inline uint16_t least_of(const uint16_t *eight) {
#if defined(__SSE4_1__)
    return uint16_t(_mm_extract_epi16(_mm_minpos_epu16(_mm_loadu_si128(reinterpret_cast<const __m128i *>(eight))), 0));
#else
    uint16_t least = eight[0];
    for (int i = 1; i < 8; ++i) least = eight[i] < least ? eight[i] : least;
    return least;
#endif
}

inline uint16_t least_of(Words v) {
    typedef uint16_t Eight __attribute__((vector_size(16)));
    Eight parts[BYTES / 16];
    memcpy(parts, &v, sizeof v);
    for (int n = BYTES / 32; n > 0; n /= 2)
        for (int i = 0; i < n; ++i) parts[i] = parts[i] < parts[i + n] ? parts[i] : parts[i + n];
    uint16_t eight[8];
    memcpy(eight, parts, sizeof eight);
    return least_of(eight);
}

template <int RADIUS>
void census_of(const uint8_t *const *rows, const uint8_t *bits, ptrdiff_t pitch, int width, uint8_t *mismatches) {
    for (int x = 0; x < width; x += BYTES) {
        const Octets centre = load<Octets>(rows[RADIUS] + x);
        Octets count = {};
        const uint8_t *bit = bits + x;
#pragma GCC unroll 7
        for (int dy = 0; dy <= 2 * RADIUS; ++dy)
#pragma GCC unroll 7
            for (int dx = -RADIUS; dx <= RADIUS; ++dx) {
                if (dy == RADIUS && dx == 0) continue;
                const Octets darker = Octets(load<Octets>(rows[dy] + x + dx) < centre);
                count -= (darker ^ load<Octets>(bit)) & load<Octets>(bit + pitch);
                bit += 2 * pitch;
            }
        memcpy(mismatches + x, &count, sizeof count);
    }
}

void census(const uint8_t *const *rows, const uint8_t *bits, ptrdiff_t pitch, int radius, int width,
            uint8_t *mismatches) {
    if (radius == 1) census_of<1>(rows, bits, pitch, width, mismatches);
    if (radius == 2) census_of<2>(rows, bits, pitch, width, mismatches);
    if (radius == 3) census_of<3>(rows, bits, pitch, width, mismatches);
}

void census_bits(const uint8_t *const *rows, ptrdiff_t pitch, int radius, int least, int width, uint8_t *bits) {
    for (int dy = 0; dy <= 2 * radius; ++dy)
        for (int dx = -radius; dx <= radius; ++dx) {
            if (dy == radius && dx == 0) continue;
            const uint8_t *aside = rows[dy] + dx, *centre = rows[radius];
            for (int x = 0; x < width; ++x) bits[x] = aside[x] < centre[x] ? 255 : 0;
            bits += pitch;
            for (int x = 0; x < width; ++x) {
                const int difference = int(aside[x]) - int(centre[x]);
                bits[x] = difference >= least || -difference >= least ? 255 : 0;
            }
            bits += pitch;
        }
}

void blend_rows(const uint8_t *__restrict upper, const uint8_t *__restrict lower, int part, int width,
                uint16_t *__restrict blended) {
    const uint16_t far = uint16_t(part), near = uint16_t(16 - part);
    for (int x = 0; x < width; ++x) blended[x] = uint16_t(near * upper[x] + far * lower[x]);
}

void blend_columns(const uint16_t *__restrict blended, int part, int width, uint8_t *__restrict row) {
    const uint16_t far = uint16_t(part), near = uint16_t(16 - part);
    for (int x = 0; x < width; ++x)
        row[x] = uint8_t(uint16_t(uint16_t(near * blended[x]) + uint16_t(far * blended[x + 1]) + 128) >> 8);
}

void add(const uint8_t *__restrict mismatches, int width, uint16_t *__restrict sum, uint8_t *__restrict seen) {
    for (int x = 0; x < width; ++x) sum[x] = uint16_t(sum[x] + mismatches[x]);
    for (int x = 0; x < width; ++x) ++seen[x];
}

void divide(const uint16_t *__restrict sum, const uint8_t *__restrict seen, const int32_t *__restrict share, int unseen,
            int width, uint8_t *__restrict costs) {
    for (int x = 0; x < width; ++x) {
        const int32_t value = (share[seen[x]] * int32_t(sum[x]) + 128) >> 8;
        costs[x] = uint8_t(seen[x] == 0 ? unseen : value < 255 ? value : 255);
    }
}

void weigh(const uint8_t *__restrict row, int weight, int width, int32_t *__restrict sum) {
    for (int x = 0; x < width; ++x) sum[x] += weight * int32_t(row[x]);
}

void look_up(const int32_t *__restrict sum, const uint8_t *__restrict seen, int views, const uint8_t *__restrict table,
             int width, uint8_t *__restrict costs) {
    for (int x = 0; x < width; ++x) {
        const int32_t size = (sum[x] < 0 ? -sum[x] : sum[x]) >> 8;
        const int32_t cost = costs[x] + (seen[x] == views ? table[size < 255 ? size : 255] : 0);
        costs[x] = uint8_t(cost < 255 ? cost : 255);
    }
}

void turn(const uint8_t *__restrict costs, ptrdiff_t pitch, int candidates, int width, uint8_t *__restrict cost) {
    constexpr int SIDE = 16;
    for (int x0 = 0; x0 < width; x0 += SIDE)
        for (int d0 = 0; d0 < candidates; d0 += SIDE) {
            const int across = width - x0 < SIDE ? width - x0 : SIDE;
            const int down = candidates - d0 < SIDE ? candidates - d0 : SIDE;
            for (int x = x0; x < x0 + across; ++x)
                for (int d = d0; d < d0 + down; ++d) cost[ptrdiff_t(x) * candidates + d] = costs[d * pitch + x];
        }
}

template <int PATHS>
void advance_of(const uint16_t *cost, int padded, int small, const Step *steps, uint16_t *const *after, uint16_t *least,
                uint16_t *total, int add) {
    Words lowest[PATHS], below[PATHS];
#pragma GCC unroll 4
    for (int p = 0; p < PATHS; ++p) {
        lowest[p] = Words{} + uint16_t(0xffff);
        below[p] = load<Words>(steps[p].before - 1);
    }
    for (int d = 0; d < padded; d += WORDS) {
        const Words here = load<Words>(cost + d);
        Words sum = add ? load<Words>(total + d) : Words{};
#pragma GCC unroll 4
        for (int p = 0; p < PATHS; ++p) {
            const uint16_t *before = steps[p].before + d;
            const Words aside = smaller(below[p], load<Words>(before + 1)) + uint16_t(small);
            const Words jump = Words{} + uint16_t(steps[p].least + steps[p].jump);
            const Words best = smaller(smaller(load<Words>(before), jump), aside);
            const Words value = here + (best - steps[p].least);
            lowest[p] = smaller(lowest[p], value);
            below[p] = load<Words>(before + WORDS - 1);  // before it may be overwritten: a path is updated in place
            memcpy(after[p] + d, &value, sizeof value);
            sum += value;
        }
        memcpy(total + d, &sum, sizeof sum);
    }
#pragma GCC unroll 4
    for (int p = 0; p < PATHS; ++p) least[p] = least_of(lowest[p]);
}

void advance(const uint16_t *cost, int padded, int small, const Step *steps, int paths, uint16_t *const *after,
             uint16_t *least, uint16_t *total, int add) {
    if (paths == 4) advance_of<4>(cost, padded, small, steps, after, least, total, add);
}

}  // namespace

extern const ApertureSimd JOIN(apertures_, SIMD) = {TEXT(SIMD), census,  census_bits, blend_rows, blend_columns,
                                                        add,        divide,  weigh,  look_up,  turn,        advance};
