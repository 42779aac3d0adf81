#include "wiener.h"

#include "wiener_light.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <ctime>
#include <memory>
#include <thread>
#include <type_traits>
#include <vector>

namespace {

constexpr int NODE = 4;  // px between the points at which the influence of lost light is worked out
constexpr int PER_CELL = CELL / NODE;
constexpr int SCANNED = 16;  // nodes of a row whose brightest pixel is looked for at once
constexpr float ZERO_TO = 2.0f, ONE_FROM = 2.5f;  // share of the result, by distance from lost light in blur lengths
constexpr float STEEPEST =
    2.0f;  // of a scene that fits the sensor's range, times full scale over the length of the blur

// Codes of linear light, at most MOST at a time.
template <class Code>
class Encoder {
  public:
    static constexpr int MOST = CELL * CELL;

    Encoder(const Codec &codec, const Simd &simd) : table_(codec.encode), steps_(float(codec.encode_steps)), simd_(simd) {
        if constexpr (std::is_same_v<Code, uint8_t>) {
            nearest_.resize(size_t(codec.encode_steps) + 2);
            for (size_t i = 0; i < nearest_.size(); ++i) nearest_[i] = uint8_t(table_[i] + 0.5f);
        }
    }

    void encode(const float *light, int count, Code *out) const {
        if constexpr (std::is_same_v<Code, float>) {
            std::copy_n(light, count, out);
            return;
        }
        float position[MOST];
        int32_t index[MOST];
        // the nearest entry, or the one below
        constexpr bool nearest = std::is_same_v<Code, uint8_t>;
        simd_.index(light, count, steps_, nearest ? 0.5f : 0.0f, position, index);
        const uint8_t *const codes = nearest_.data();
        for (int i = 0; i < count; ++i) {
            if constexpr (nearest) {
                out[i] = codes[index[i]];
            } else {
                const float low = table_[index[i]], high = table_[index[i] + 1];
                out[i] = Code(low + (high - low) * (position[i] - float(index[i])) + 0.5f);
            }
        }
    }

  private:
    const float *table_;
    float steps_;
    const Simd &simd_;
    std::vector<uint8_t> nearest_;
};

// Where light that the sensor could not hold spoils the result: saturated pixels beside which the image is steeper
// along the blur than the blur of any scene within the sensor's range could be.
class LostLight {
  public:
    LostLight(Image size, const Field &field)
        : size_(size), field_(field), ny_(PER_CELL * field.ny + 1), nx_(PER_CELL * field.nx + 1) {}

    template <class Code>
    void find(const Code *image, const Codec &codec, int threads) {
        const int threshold = codec.saturated;
        near_.assign(size_t(ny_) * size_t(nx_), 0);
        const int blocks_y = (size_.height + NODE - 1) / NODE, blocks_x = (size_.width + NODE - 1) / NODE;
        const int line = size_.width * size_.channels, block = NODE * size_.channels;
        std::vector<unsigned char> blocks(size_t(blocks_y) * size_t(blocks_x), 0);
        std::atomic<bool> any{false};
        in_parallel(blocks_y, threads, [&](int i) {
            for (int y = i * NODE; y < std::min((i + 1) * NODE, size_.height); ++y) {
                const Code *row = image + ptrdiff_t(y) * line;
                for (int begin = 0; begin < line; begin += SCANNED * block) {
                    const int end = std::min(begin + SCANNED * block, line);
                    Code top = 0;
                    for (int x = begin; x < end; ++x) top = std::max(top, row[x]);
                    if (top < threshold) continue;
                    for (int x = begin; x < end; ++x) {
                        if (row[x] < threshold) continue;
                        unsigned char &lost = blocks[size_t(i) * blocks_x + x / block];
                        if (lost || !steep(image, codec, y, x / size_.channels, x % size_.channels)) continue;
                        lost = 1;
                        any = true;
                    }
                }
            }
        });
        any_ = any;
        if (!any_) return;
        for (int i = 0; i < blocks_y; ++i)
            for (int j = 0; j < blocks_x; ++j)
                if (blocks[size_t(i) * blocks_x + j])
                    for (int dy = 0; dy < 2; ++dy)
                        for (int dx = 0; dx < 2; ++dx) near_[size_t(i + dy) * nx_ + j + dx] = 1;
        sums_.assign(size_t(ny_ + 1) * size_t(nx_ + 1), 0);
        for (int i = 0; i < ny_; ++i)
            for (int j = 0, row = 0; j < nx_; ++j) {
                row += near_[size_t(i) * nx_ + j];
                sums_[size_t(i + 1) * (nx_ + 1) + j + 1] = sums_[size_t(i) * (nx_ + 1) + j + 1] + row;
            }
    }

    // Shares of the result at the nodes of a cell; false where all of them are one.
    bool shares(int cy, int cx, float (&share)[PER_CELL + 1][PER_CELL + 1]) const {
        if (!any_) return false;
        // The nodes on the far borders have the blur of the next cells.
        float reach_y = 0, reach_x = 0;
        for (int y = cy; y < std::min(cy + 2, field_.ny); ++y)
            for (int x = cx; x < std::min(cx + 2, field_.nx); ++x) {
                const size_t cell = size_t(y) * field_.nx + x;
                const float major = ONE_FROM * field_.extent[cell], minor = major * std::abs(field_.slope[cell]);
                reach_y = std::max(reach_y, field_.along_y[cell] ? major : minor);
                reach_x = std::max(reach_x, field_.along_y[cell] ? minor : major);
            }
        const int top = std::max(0, cy * PER_CELL - int(reach_y / NODE) - 1),
                  left = std::max(0, cx * PER_CELL - int(reach_x / NODE) - 1);
        const int bottom = std::min(ny_, (cy + 1) * PER_CELL + int(reach_y / NODE) + 2);
        const int right = std::min(nx_, (cx + 1) * PER_CELL + int(reach_x / NODE) + 2);
        if (sum(bottom, right) - sum(top, right) - sum(bottom, left) + sum(top, left) == 0) return false;
        float least = 1;
        for (int i = 0; i <= PER_CELL; ++i)
            for (int j = 0; j <= PER_CELL; ++j) {
                share[i][j] = share_at(cy * PER_CELL + i, cx * PER_CELL + j);
                least = std::min(least, share[i][j]);
            }
        return least < 1;
    }

  private:
    int sum(int y, int x) const { return sums_[size_t(y) * (nx_ + 1) + x]; }

    template <class Code>
    bool steep(const Code *image, const Codec &codec, int y, int x, int channel) const {
        const size_t cell = size_t(y / CELL) * field_.nx + x / CELL;
        const float extent = field_.extent[cell];
        const int major = std::max(1, int(extent / 4 + 0.5f)),
                  minor = int(std::floor(float(major) * field_.slope[cell] + 0.5f));
        const int dy = field_.along_y[cell] ? major : minor, dx = field_.along_y[cell] ? minor : major;
        auto light = [&](int at_y, int at_x) {
            at_y = std::min(std::max(at_y, 0), size_.height - 1);
            at_x = std::min(std::max(at_x, 0), size_.width - 1);
            return codec.decode[image[(ptrdiff_t(at_y) * size_.width + at_x) * size_.channels + channel]];
        };
        const float fall = light(y, x) - std::min(light(y + dy, x + dx), light(y - dy, x - dx));
        return fall * extent > STEEPEST * float(major);
    }

    bool near(int y, int x) const { return y >= 0 && y < ny_ && x >= 0 && x < nx_ && near_[size_t(y) * nx_ + x]; }

    // Zero where the filter reaches lost light, one half a blur length further on.
    float share_at(int i, int j) const {
        const size_t cell =
            size_t(std::min(i / PER_CELL, field_.ny - 1)) * field_.nx + std::min(j / PER_CELL, field_.nx - 1);
        const float extent = field_.extent[cell], slope = field_.slope[cell];
        const bool along_y = field_.along_y[cell];
        for (int step = 0; float(NODE * step) <= ONE_FROM * extent; ++step) {
            const int minor = int(std::floor(float(step) * slope + 0.5f));
            const int dy = along_y ? step : minor, dx = along_y ? minor : step;
            if (near(i + dy, j + dx) || near(i - dy, j - dx))
                return std::min(
                    std::max((float(NODE * step) / std::max(extent, 1e-6f) - ZERO_TO) / (ONE_FROM - ZERO_TO), 0.0f),
                    1.0f);
        }
        return 1;
    }

    Image size_;
    const Field &field_;
    int ny_, nx_;
    bool any_ = false;
    std::vector<unsigned char> near_;
    std::vector<int> sums_;
};

template <class Code>
class Deblur {
  public:
    Deblur(const Code *image, Code *result, Image size, const Field &field, const Table &table, const Codec &codec,
           const Simd &simd, int threads)
        : image_(image),
          result_(result),
          size_(size),
          field_(field),
          table_(table),
          codec_(codec),
          simd_(simd),
          threads_(threads),
          encoder_(codec, simd),
          lost_light_(size, field) {}

    Seconds run() {
        const std::clock_t start = std::clock();
        if constexpr (!std::is_same_v<Code, float>) lost_light_.find(image_, codec_, threads_);
        decode();
        const std::clock_t middle = std::clock();
        in_parallel(field_.ny, threads_, [&](int cy) { filter_row(cy); });
        const std::clock_t end = std::clock();
        return {double(middle - start) / CLOCKS_PER_SEC, double(end - middle) / CLOCKS_PER_SEC};
    }

    // The result of another filter, as linear light, in place of its own. Channels lie side by side all the way.
    void blend(const float *light) {
        lost_light_.find(image_, codec_, threads_);
        const int pixel = size_.channels, together = Encoder<Code>::MOST;
        const size_t line = size_t(size_.width) * size_t(pixel);
        in_parallel(field_.ny, threads_, [&](int cy) {
            std::vector<float> mixed(size_t(CELL) * size_t(pixel));
            for (int cx = 0; cx < field_.nx; ++cx) {
                if (faded(cy, cx)) {
                    copy(cy, cx);
                    continue;
                }
                float share[CELL][CELL];
                const bool blended = shares(cy, cx, share);
                const int rows = std::min(CELL, size_.height - cy * CELL),
                          count = std::min(CELL, size_.width - cx * CELL) * pixel;
                for (int y = 0; y < rows; ++y) {
                    const size_t at = size_t(cy * CELL + y) * line + size_t(cx * CELL) * size_t(pixel);
                    const float *row = light + at;
                    if (blended) {
                        for (int i = 0; i < count; ++i) {
                            const float before = light_of(image_[at + size_t(i)], codec_);
                            mixed[size_t(i)] = before + share[y][i / pixel] * (row[i] - before);
                        }
                        row = mixed.data();
                    }
                    for (int i = 0; i < count; i += together)
                        encoder_.encode(row + i, std::min(together, count - i), result_ + at + i);
                    for (int i = 0; blended && i < count; ++i)
                        if (share[y][i / pixel] == 0) result_[at + size_t(i)] = image_[at + size_t(i)];
                }
            }
        });
    }

  private:
    void decode() {
        for (const bool transposed : {false, true}) {
            const int major = transposed ? size_.height : size_.width, minor = transposed ? size_.width : size_.height;
            std::vector<Span> spans(size_t((minor + BAND - 1) / BAND));
            int reach = 0;
            float steepest = 0;
            bool needed = false;
            for (int cy = 0; cy < field_.ny; ++cy)
                for (int cx = 0; cx < field_.nx; ++cx) {
                    const int cell = cy * field_.nx + cx;
                    if (field_.along_y[cell] != transposed || faded(cy, cx)) continue;
                    needed = true;
                    const float steep = std::abs(field_.slope[cell]);
                    const int along = table_.reach[row_of(cell) + 1], across = int(std::ceil(float(along) * steep)) + 1;
                    reach = std::max(reach, along);
                    steepest = std::max(steepest, steep);
                    const int at_major = (transposed ? cy : cx) * CELL, at_minor = (transposed ? cx : cy) * CELL;
                    include(spans, at_minor - across, at_minor + CELL + across, minor, at_major - along,
                            at_major + CELL + along, major);
                }
            if (!needed) continue;
            for (int channel = 0; channel < size_.channels; ++channel) {
                Plane plane;
                plane.allocate((transposed ? field_.ny : field_.nx) * CELL, (transposed ? field_.nx : field_.ny) * CELL,
                               reach, steepest);
                Filling<Code>(plane, spans, image_, size_, channel, transposed, codec_, table_, simd_).run(threads_);
                planes_[transposed].push_back(std::move(plane));
            }
        }
    }

    // Rows [top, bottom) and columns [left, right), of which some are the mirror images of others inside.
    static void include(std::vector<Span> &spans, int top, int bottom, int minor, int left, int right, int major) {
        // as far inside the border as it reaches beyond it; where that is nearly everything, everything
        auto within = [](int &from, int &to, int size) {
            const int before = std::max(0, -from), beyond = std::max(0, to - size);
            if (before >= size || beyond >= size) {
                from = 0, to = size;
                return;
            }
            from = std::min(std::max(0, from), size - 1 - beyond);
            to = std::min(size, std::max(to, before + 1));
        };
        within(top, bottom, minor);
        within(left, right, major);
        for (int i = top / BAND; i <= (bottom - 1) / BAND; ++i) spans[size_t(i)].include(left, right);
    }

    const float *corner(int cy, int cx) const { return field_.fade + size_t(cy) * (field_.nx + 1) + cx; }

    bool faded(int cy, int cx) const {
        const float *above = corner(cy, cx), *below = corner(cy + 1, cx);
        return above[0] == 0 && above[1] == 0 && below[0] == 0 && below[1] == 0;
    }

    int row_of(int cell) const {
        const float position = field_.extent[cell] * table_.steps - table_.first;
        return std::min(std::max(int(position), 0), table_.rows - 2);
    }

    void filter_row(int cy) {
        const size_t room = size_t(table_.width);
        std::vector<float> weights(2 * room);
        std::vector<int32_t> offsets(2 * room);
        Taps taps{0, weights.data(), weights.data() + room, offsets.data(), offsets.data() + room};
        for (int cx = 0; cx < field_.nx; ++cx) {
            if (faded(cy, cx)) {
                copy(cy, cx);
                continue;
            }
            const int cell = cy * field_.nx + cx, row = row_of(cell);
            const bool transposed = field_.along_y[cell];
            const float *lower = table_.weights + size_t(row) * room;
            taps.reach = table_.reach[row + 1];
            const float fraction = field_.extent[cell] * table_.steps - table_.first - float(row);
            simd_.place(lower, lower + room, fraction, field_.slope[cell], planes_[transposed][0].stride, taps);
            float share[CELL][CELL];
            const bool blended = shares(cy, cx, share);
            for (int channel = 0; channel < size_.channels; ++channel) {
                const Plane &plane = planes_[transposed][channel];
                alignas(64) float tile[CELL * CELL];
                const float *source = transposed ? plane.at(cy * CELL, cx * CELL) : plane.at(cx * CELL, cy * CELL);
                simd_.filter(source, plane.stride, taps, tile);
                write(cy, cx, channel, tile, transposed, blended ? share : nullptr);
            }
        }
    }

    // Shares of the result at the pixels of a cell; false where all of them are one.
    bool shares(int cy, int cx, float (&share)[CELL][CELL]) const {
        const float *above = corner(cy, cx), *below = corner(cy + 1, cx);
        float nodes[PER_CELL + 1][PER_CELL + 1];
        const bool spoilt = lost_light_.shares(cy, cx, nodes);
        if (!spoilt && above[0] == 1 && above[1] == 1 && below[0] == 1 && below[1] == 1) return false;
        for (int y = 0; y < CELL; ++y) {
            const float s = float(y) / CELL, s_node = float(y % NODE) / NODE;
            for (int x = 0; x < CELL; ++x) {
                const float t = float(x) / CELL, t_node = float(x % NODE) / NODE;
                share[y][x] = (above[0] * (1 - t) + above[1] * t) * (1 - s) + (below[0] * (1 - t) + below[1] * t) * s;
                if (!spoilt) continue;
                const float *upper = &nodes[y / NODE][x / NODE], *lower = &nodes[y / NODE + 1][x / NODE];
                share[y][x] *= (upper[0] * (1 - t_node) + upper[1] * t_node) * (1 - s_node) +
                               (lower[0] * (1 - t_node) + lower[1] * t_node) * s_node;
            }
        }
        return true;
    }

    void write(int cy, int cx, int channel, float *tile, bool transposed, const float (*share)[CELL]) {
        const int rows = std::min(CELL, size_.height - cy * CELL), columns = std::min(CELL, size_.width - cx * CELL);
        const size_t pixel = size_t(size_.channels), line = size_t(size_.width) * pixel;
        const size_t at = size_t(cy * CELL) * line + size_t(cx * CELL) * pixel + size_t(channel);
        const Code *in = image_ + at;
        Code *out = result_ + at;
        if (share)
            for (int y = 0; y < rows; ++y)
                for (int x = 0; x < columns; ++x) {
                    const float before = light_of(in[y * line + x * pixel], codec_);
                    float &light = tile[transposed ? x * CELL + y : y * CELL + x];
                    light = before + share[y][x] * (light - before);
                }
        Code codes[CELL * CELL];
        encoder_.encode(tile, CELL * CELL, codes);
        for (int y = 0; y < rows; ++y)
            for (int x = 0; x < columns; ++x) {
                const int i = transposed ? x * CELL + y : y * CELL + x;
                out[y * line + x * pixel] = share && share[y][x] == 0 ? in[y * line + x * pixel] : codes[i];
            }
    }

    void copy(int cy, int cx) {
        const int rows = std::min(CELL, size_.height - cy * CELL), columns = std::min(CELL, size_.width - cx * CELL);
        for (int y = 0; y < rows; ++y) {
            const size_t at =
                (size_t(cy * CELL + y) * size_t(size_.width) + size_t(cx * CELL)) * size_t(size_.channels);
            std::memcpy(result_ + at, image_ + at, size_t(columns) * size_t(size_.channels) * sizeof(Code));
        }
    }

    const Code *image_;
    Code *result_;
    Image size_;
    const Field &field_;
    const Table &table_;
    const Codec &codec_;
    const Simd &simd_;
    int threads_;
    Encoder<Code> encoder_;
    LostLight lost_light_;
    std::vector<Plane> planes_[2];  // by channel; [1] transposed
};

}  // namespace

template <class Code>
Seconds deblur(const Code *image, Code *result, Image size, const Field &field, const Table &table, const Codec &codec,
               const Simd &simd, int threads) {
    return Deblur<Code>(image, result, size, field, table, codec, simd, threads).run();
}

template <class Code>
void blend(const Code *image, const float *light, Code *result, Image size, const Field &field, const Codec &codec,
           const Simd &simd, int threads) {
    const Table none{};
    Deblur<Code>(image, result, size, field, none, codec, simd, threads).blend(light);
}

void join(const float *luma, const float *lines, Image size, float red, float blue, float *result, const Simd &simd,
          int threads) {
    const int half = (size.width + 1) / 2, half_rows = (size.height + 1) / 2;
    in_parallel((size.height + BAND - 1) / BAND, threads, [&](int band) {
        std::vector<float> room(size_t(10 * half + 4));
        for (int y = band * BAND; y < std::min((band + 1) * BAND, size.height); ++y) {
            const int row = y / 2, beyond = std::min(std::max(row + (y % 2 ? 1 : -1), 0), half_rows - 1);
            const float *near[4], *far[4];
            for (int plane = 0; plane < 4; ++plane) {
                near[plane] = lines + (size_t(plane) * half_rows + row) * half;
                far[plane] = lines + (size_t(plane) * half_rows + beyond) * half;
            }
            const size_t at = size_t(y) * size.width;
            simd.join(luma + at, near, far, half, size.width, red, blue, room.data(), result + 3 * at);
        }
    });
}

void encode(const float *light, size_t count, uint8_t *result, const Codec &codec, const Simd &simd) {
    const Encoder<uint8_t> encoder(codec, simd);
    const size_t together = Encoder<uint8_t>::MOST;
    for (size_t i = 0; i < count; i += together)
        encoder.encode(light + i, int(std::min(together, count - i)), result + i);
}

template void blend(const uint8_t *, const float *, uint8_t *, Image, const Field &, const Codec &, const Simd &, int);
template void blend(const uint16_t *, const float *, uint16_t *, Image, const Field &, const Codec &, const Simd &,
                    int);
template Seconds deblur(const uint8_t *, uint8_t *, Image, const Field &, const Table &, const Codec &, const Simd &,
                        int);
template Seconds deblur(const uint16_t *, uint16_t *, Image, const Field &, const Table &, const Codec &, const Simd &,
                        int);
template Seconds deblur(const float *, float *, Image, const Field &, const Table &, const Codec &, const Simd &, int);
