// Linear light of an image in planes that the filter can read: mirrored surroundings, smoothed, rows or columns.
#pragma once

#include "in_parallel.h"
#include "wiener.h"

#include <algorithm>
#include <atomic>
#include <climits>
#include <cmath>
#include <memory>
#include <thread>
#include <type_traits>
#include <vector>

// Linear light with its mirrored surroundings. Transposed for cells whose major axis is y, so that the taps always
// run along the rows.
struct Plane {
    int before_major = 0, before_minor = 0;  // px of surroundings
    int width = 0, height = 0;
    ptrdiff_t stride = 0;
    std::unique_ptr<float[]> data;  // not set to zero: every element that is read is written

    void allocate(int major, int minor, int reach, float steepest) {
        before_major = reach + 1;
        before_minor = int(std::ceil(float(reach) * steepest)) + 1;
        width = major + 2 * before_major;
        height = minor + 2 * before_minor + 1;
        // 11 cache lines beyond a multiple of 64: the rows around a cell spread over all sets of the first-level cache.
        stride = ((width + 15) / 16 + 52) / 64 * 64 + 11;
        stride *= 16;
        data.reset(new float[size_t(stride) * size_t(height)]);
    }
    const float *at(int major, int minor) const {
        return data.get() + (minor + before_minor) * stride + major + before_major;
    }
};

template <class Code>
float light_of(Code code, const Codec &codec) {
    if constexpr (std::is_same_v<Code, float>)
        return code;
    else
        return codec.decode[code];
}

constexpr int BAND = 48;  // rows of a plane that are made together

// What is read of a band of rows: nothing, or a range of columns.
struct Span {
    int first = INT_MAX, last = 0;
    bool empty() const { return first >= last; }
    void include(int from, int to) {
        first = std::min(first, from);
        last = std::max(last, to);
    }
};

// Linear light of an image, smoothed, with its mirrored surroundings, where it is read. Smoothed a band of rows at a
// time, so that what is in between stays in the cache; mirroring goes before smoothing or after it alike.
template <class Code>
class Filling {
  public:
    Filling(Plane &plane, const std::vector<Span> &spans, const Code *image, Image size, int channel, bool transposed,
            const Codec &codec, const Table &table, const Simd &simd)
        : plane_(plane),
          spans_(spans),
          image_(image + channel),
          codec_(codec),
          table_(table),
          simd_(simd),
          major_(transposed ? size.height : size.width),
          minor_(transposed ? size.width : size.height),
          together_(transposed ? TOGETHER : 1) {
        const ptrdiff_t pixel = size.channels, line = ptrdiff_t(size.width) * pixel;
        major_step_ = transposed ? line : pixel;
        minor_step_ = transposed ? pixel : line;
    }

    void run(int threads) {
        in_parallel(int(spans_.size()), threads, [&](int i) {
            if (!spans_[size_t(i)].empty()) band(i * BAND, std::min(minor_, (i + 1) * BAND), spans_[size_t(i)]);
        });
        in_parallel(plane_.height - minor_, threads, [&](int i) {
            const int y = i < plane_.before_minor ? i - plane_.before_minor : minor_ + i - plane_.before_minor;
            const int inside = mirrored(y, minor_);
            const Span span = spans_[size_t(inside / BAND)];
            if (span.empty()) return;
            const int first = span.first == 0 ? 0 : plane_.before_major + span.first;
            const int last = span.last == major_ ? plane_.width : plane_.before_major + span.last;
            std::copy(line(inside) + first, line(inside) + last, line(y) + first);
        });
    }

  private:
    static constexpr int TOGETHER = 16;  // transposed, 16 rows lie on the same cache lines of the image

    float *line(int y) const { return plane_.data.get() + (y + plane_.before_minor) * plane_.stride; }

    void band(int first, int last, Span span) {
        const int radius = table_.radius;
        const size_t margin = size_t((radius + 15) / 16 * 16), pitch = (size_t(major_) + 2 * margin + 15) / 16 * 16;
        // light as it was decoded, and smoothed along the rows: room for as many as are alive
        thread_local std::vector<float> room;
        room.resize(pitch * size_t(TOGETHER + BAND + 2 * radius));
        float *const rows = room.data() + TOGETHER * pitch;
        const int low = first - radius, high = last + radius;
        for (int y = low; y < high; y += together_) {
            const int count = std::min(together_, high - y);
            float *raw[TOGETHER];
            for (int r = 0; r < count; ++r)
                raw[r] = radius ? room.data() + size_t(r) * pitch + margin : line(y + r) + plane_.before_major;
            decode(y, count, std::max(0, span.first - radius), std::min(major_, span.last + radius), raw);
            for (int r = 0; r < count && radius; ++r) along(raw[r], span, rows + size_t(y + r - low) * pitch);
        }
        for (int y = first; y < last; ++y) {
            float *target = line(y) + plane_.before_major;
            if (radius) combine(rows + size_t(y - low) * pitch, ptrdiff_t(pitch), span, target);
            auto mirror = [&](int from, int to) {
                for (int x = from; x < to; ++x) {
                    const int inside = mirrored(x, major_);
                    if (inside >= span.first && inside < span.last) target[x] = target[inside];
                }
            };
            if (span.first == 0) mirror(-plane_.before_major, 0);
            if (span.last == major_) mirror(major_, plane_.width - plane_.before_major);
        }
    }

    void decode(int first, int count, int from, int to, float *const *target) const {
        const Code *source[TOGETHER];
        for (int r = 0; r < count; ++r) source[r] = image_ + mirrored(first + r, minor_) * minor_step_;
        if (count == 1)
            for (int x = from; x < to; ++x) target[0][x] = light_of(source[0][x * major_step_], codec_);
        else
            for (int x = from; x < to; ++x)
                for (int r = 0; r < count; ++r) target[r][x] = light_of(source[r][x * major_step_], codec_);
    }

    void along(float *row, Span span, float *target) const {
        for (int k = 1; k <= table_.radius; ++k) {
            if (span.first < table_.radius) row[-k] = row[mirrored(-k, major_)];
            if (span.last > major_ - table_.radius) row[major_ - 1 + k] = row[mirrored(major_ - 1 + k, major_)];
        }
        combine(row, 1, span, target);
    }

    // Weighted sums of what lies `step` apart, of a range of columns.
    void combine(const float *row, ptrdiff_t step, Span span, float *target) const {
        const float *sources[1 + 2 * MOST_RADIUS] = {row + span.first};
        for (int k = 1; k <= table_.radius; ++k) {
            sources[2 * k - 1] = row + span.first - k * step;
            sources[2 * k] = row + span.first + k * step;
        }
        simd_.combine(sources, table_.smoothing, table_.radius, target + span.first, span.last - span.first);
    }

    Plane &plane_;
    const std::vector<Span> &spans_;
    const Code *image_;
    const Codec &codec_;
    const Table &table_;
    const Simd &simd_;
    int major_, minor_, together_;
    ptrdiff_t major_step_, minor_step_;
};
