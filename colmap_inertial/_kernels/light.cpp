#include "light.h"

#include "in_parallel.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <type_traits>
#include <vector>

namespace {

constexpr int NODE = 4;  // px between the points at which the influence of lost light is worked out
constexpr int PER_CELL = CELL / NODE;
constexpr int SCANNED = 16;  // nodes of a row whose brightest pixel is looked for at once
constexpr float ZERO_TO = 2.0f, ONE_FROM = 2.5f;  // share of the result, by distance from lost light in blur lengths
constexpr float STEEPEST = 2.0f;  // of a scene that fits the sensor's range, times full scale over the blur's length
constexpr int BAND = 48;          // rows whose colours are joined together

// Codes of linear light, at most MOST at a time.
template <class Code>
class Encoder {
  public:
    static constexpr int MOST = CELL * CELL;

    explicit Encoder(const Codec &codec) : table_(codec.encode), steps_(float(codec.encode_steps)) {
        if constexpr (NEAREST) {
            nearest_.resize(size_t(codec.encode_steps) + 2);
            for (size_t i = 0; i < nearest_.size(); ++i) nearest_[i] = uint8_t(table_[i] + 0.5f);
        }
    }

    void encode(const float *light, int count, Code *out) const {
        float position[MOST];
        int32_t index[MOST];
        for (int i = 0; i < count; ++i) {
            const float clipped = light[i] < 0.0f ? 0.0f : light[i];
            position[i] = (clipped > 1.0f ? 1.0f : clipped) * steps_ + (NEAREST ? 0.5f : 0.0f);
            index[i] = int32_t(position[i]);
        }
        const uint8_t *const codes = nearest_.data();
        for (int i = 0; i < count; ++i) {
            if constexpr (NEAREST) {
                out[i] = codes[index[i]];
            } else {
                const float low = table_[index[i]], high = table_[index[i] + 1];
                out[i] = Code(low + (high - low) * (position[i] - float(index[i])) + 0.5f);
            }
        }
    }

  private:
    static constexpr bool NEAREST = std::is_same_v<Code, uint8_t>;  // entry of the table; else between two

    const float *table_;
    float steps_;
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

    bool any() const { return any_; }

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
class Blend {
  public:
    Blend(const Code *image, const float *light, Code *result, Image size, const Field &field, const Codec &codec)
        : image_(image),
          light_(light),
          result_(result),
          size_(size),
          field_(field),
          codec_(codec),
          encoder_(codec),
          lost_light_(size, field) {}

    void run(int threads) {
        lost_light_.find(image_, codec_, threads);
        in_parallel(field_.ny, threads, [&](int cy) {
            std::vector<float> mixed(size_t(CELL) * size_t(size_.channels));
            for (int cx = 0; cx < field_.nx; ++cx) {
                if (faded(cy, cx))
                    copy(cy, cx);
                else
                    write(cy, cx, mixed.data());
            }
        });
    }

  private:
    void write(int cy, int cx, float *mixed) {
        float share[CELL][CELL];
        const bool blended = shares(cy, cx, share);
        const int pixel = size_.channels, together = Encoder<Code>::MOST;
        const int rows = std::min(CELL, size_.height - cy * CELL),
                  count = std::min(CELL, size_.width - cx * CELL) * pixel;
        for (int y = 0; y < rows; ++y) {
            const size_t at = first(cy, cx, y);
            const float *row = light_ + at;
            if (blended) {
                for (int i = 0; i < count; ++i) {
                    const float before = codec_.decode[image_[at + size_t(i)]];
                    mixed[i] = before + share[y][i / pixel] * (row[i] - before);
                }
                row = mixed;
            }
            for (int i = 0; i < count; i += together)
                encoder_.encode(row + i, std::min(together, count - i), result_ + at + i);
            for (int i = 0; blended && i < count; ++i)
                if (share[y][i / pixel] == 0) result_[at + size_t(i)] = image_[at + size_t(i)];
        }
    }

    void copy(int cy, int cx) {
        const int rows = std::min(CELL, size_.height - cy * CELL), columns = std::min(CELL, size_.width - cx * CELL);
        const size_t bytes = size_t(columns) * size_t(size_.channels) * sizeof(Code);
        for (int y = 0; y < rows; ++y) std::memcpy(result_ + first(cy, cx, y), image_ + first(cy, cx, y), bytes);
    }

    // Where a row of a cell begins.
    size_t first(int cy, int cx, int y) const {
        return (size_t(cy * CELL + y) * size_t(size_.width) + size_t(cx * CELL)) * size_t(size_.channels);
    }

    const float *corner(int cy, int cx) const { return field_.fade + size_t(cy) * (field_.nx + 1) + cx; }

    bool faded(int cy, int cx) const {
        const float *above = corner(cy, cx), *below = corner(cy + 1, cx);
        return above[0] == 0 && above[1] == 0 && below[0] == 0 && below[1] == 0;
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

    const Code *image_;
    const float *light_;
    Code *result_;
    Image size_;
    const Field &field_;
    const Codec &codec_;
    Encoder<Code> encoder_;
    LostLight lost_light_;
};

// Marks the pixels of a cell between four nodes of which none has a share.
void mark_spoilt(const LostLight &lost_light, Image size, int cy, int cx, uint8_t *spoilt) {
    float nodes[PER_CELL + 1][PER_CELL + 1];
    if (!lost_light.shares(cy, cx, nodes)) return;
    for (int y = 0; y < std::min(CELL, size.height - cy * CELL); ++y)
        for (int x = 0; x < std::min(CELL, size.width - cx * CELL); ++x) {
            const float *upper = &nodes[y / NODE][x / NODE], *lower = &nodes[y / NODE + 1][x / NODE];
            spoilt[size_t(cy * CELL + y) * size_t(size.width) + size_t(cx * CELL + x)] =
                upper[0] == 0 && upper[1] == 0 && lower[0] == 0 && lower[1] == 0;
        }
}

// A row of colours. near and far: slopes and offsets of R - G and B - G over luma, one after the other, in the next row
// of half the size and the one beyond, of `half` pixels. room: 10 half + 4 floats.
void join_row(const float *__restrict luma, const float *const *near, const float *const *far, int half, int width,
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

}  // namespace

template <class Code>
void blend(const Code *image, const float *light, Code *result, Image size, const Field &field, const Codec &codec,
           int threads) {
    Blend<Code>(image, light, result, size, field, codec).run(threads);
}

template <class Code>
bool find_spoilt(const Code *image, uint8_t *spoilt, Image size, const Field &field, const Codec &codec, int threads) {
    LostLight lost_light(size, field);
    lost_light.find(image, codec, threads);
    if (!lost_light.any()) return false;
    in_parallel(field.ny, threads, [&](int cy) {
        for (int cx = 0; cx < field.nx; ++cx) mark_spoilt(lost_light, size, cy, cx, spoilt);
    });
    return true;
}

template bool find_spoilt(const uint8_t *, uint8_t *, Image, const Field &, const Codec &, int);
template bool find_spoilt(const uint16_t *, uint8_t *, Image, const Field &, const Codec &, int);

template void blend(const uint8_t *, const float *, uint8_t *, Image, const Field &, const Codec &, int);
template void blend(const uint16_t *, const float *, uint16_t *, Image, const Field &, const Codec &, int);

void join(const float *luma, const float *lines, Image size, float red, float blue, float *result, int threads) {
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
            join_row(luma + at, near, far, half, size.width, red, blue, room.data(), result + 3 * at);
        }
    });
}

void encode(const float *light, size_t count, uint8_t *result, const Codec &codec) {
    const Encoder<uint8_t> encoder(codec);
    const size_t together = Encoder<uint8_t>::MOST;
    for (size_t i = 0; i < count; i += together)
        encoder.encode(light + i, int(std::min(together, count - i)), result + i);
}
