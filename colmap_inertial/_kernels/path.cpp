#include "path.h"

#include "in_parallel.h"

#include <cmath>
#include <cstring>
#include <memory>
#include <mutex>
#include <numeric>

namespace {

constexpr double PI = 3.14159265358979323846;

using Floats = std::unique_ptr<float[]>;

Floats floats(size_t count) { return Floats(new float[count]()); }

Floats unset(size_t count) { return Floats(new float[count]); }

// What is the same for all tiles.
struct Common {
    Square square;
    size_t count;  // of a spectrum, with what does not count
    std::vector<float> twiddles;
    Floats flattened;  // square of the frequency + flat_below^2, what the prior divides by
    Floats band;       // 1 where the prior is fitted, 2 where the other half has the same, else 0
    Floats fitted;     // that times the square of the frequency
    int reach;         // where both end, along x and y
    Floats gradient;   // power of differences
    Floats high;       // 1 or 2 above a frequency, else 0
    Floats vertical;   // frequencies of the columns
    double window_power;

    explicit Common(const Tiles &tiles) : square{tiles.side, tiles.side + 16, tiles.side / 2 + 16} {
        count = size_t(square.side) * size_t(square.half);
        twiddles = twiddles_of(square.side);
        vertical = floats(size_t(square.half));
        for (int y = 0; y <= square.side / 2; ++y) vertical[y] = float(y) / float(square.side);
        double power = 0;
        for (int i = 0; i < tiles.side; ++i) power += double(tiles.window_in[i]) * double(tiles.window_in[i]);
        window_power = power * power;
    }

    template <class Value>
    Floats over_frequencies(Value value, float rest) const {
        Floats out = unset(count);
        const int side = square.side, half = square.half;
        for (int x = 0; x < side; ++x) {
            const double fx = double(x <= side / 2 ? x : x - side) / side;
            for (int y = 0; y < half; ++y)
                out[size_t(x) * half + y] =
                    y <= side / 2 ? float(value(fx, double(y) / side, y % (side / 2) ? 2.0 : 1.0)) : rest;
        }
        return out;
    }
};

// Memory of one thread.
struct Room {
    Floats tile, other, power, doubt, scratch, real[8], cos_x, sin_x, cos_y, sin_y;
    std::unique_ptr<double[]> angles;
    Spectrum spectrum, transfer, data, lean;

    Room(const Common &common, int samples) {
        const size_t side = size_t(common.square.side), pitch = size_t(common.square.pitch);
        tile = floats(side * pitch);
        other = floats(side * pitch);
        power = floats(common.count);
        doubt = floats(common.count);
        scratch = floats(room_of(common.square));
        for (auto &plane : real) plane = floats(common.count);
        spectrum = {real[0].get(), real[1].get()};
        transfer = {real[2].get(), real[3].get()};
        data = {real[4].get(), real[5].get()};
        lean = {real[6].get(), real[7].get()};
        angles.reset(new double[4 * size_t(samples)]);
        cos_x = floats((side / 2 + 1) * size_t(samples));
        sin_x = floats((side / 2 + 1) * size_t(samples));
        cos_y = floats(size_t(common.square.half) * size_t(samples));
        sin_y = floats(size_t(common.square.half) * size_t(samples));
    }
};

class Filter {
  public:
    Filter(const Light &light, const Tiles &tiles, const PathSimd &simd, int threads)
        : light_(light), tiles_(tiles), simd_(simd), threads_(threads), common_(tiles) {
        width_ = (tiles.columns - 1) * tiles.hop + tiles.side;
        // of the result, only columns that count are transformed back
        begin_ = 0, end_ = tiles.side;
        while (begin_ < end_ && tiles.window_out[begin_] == 0) ++begin_;
        while (end_ > begin_ && tiles.window_out[end_ - 1] == 0) --end_;
        // where the image, mirrored about its borders, has what the tiles' columns show
        columns_of_.resize(size_t(width_));
        for (int x = 0; x < width_; ++x) columns_of_[x] = mirrored(x - tiles.before, light.width) * light.channels;
        first_ = begin_ / MOST_LANES * MOST_LANES;
        columns_ = (end_ - first_ + 2 * MOST_LANES - 1) / (2 * MOST_LANES) * MOST_LANES;
        first_ = std::min(first_, tiles.side - 2 * columns_);
        for (int ends = 0; ends < 4; ++ends) {
            shares_[ends].assign(tiles.window_out, tiles.window_out + tiles.side);
            const auto middle = shares_[ends].begin() + tiles.side / 2;
            if (ends & 1) std::fill(shares_[ends].begin(), middle, 1.0f);
            if (ends & 2) std::fill(middle, shares_[ends].end(), 1.0f);
        }
    }

    void filter(const Model &model, float *result) {
        const double flat = double(model.flat_below) * model.flat_below;
        common_.flattened =
            common_.over_frequencies([&](double x, double y, double) { return x * x + y * y + flat; }, 1);
        const auto times_in_band = [&](double x, double y, double times) {
            const double square = x * x + y * y, low = model.fitted_from, high = model.fitted_to;
            return square > low * low && square < high * high ? times : 0.0;
        };
        common_.band = common_.over_frequencies(times_in_band, 0);
        common_.reach = std::min(int(std::ceil(model.fitted_to * tiles_.side)), tiles_.side / 2);
        common_.fitted = common_.over_frequencies(
            [&](double x, double y, double times) { return times_in_band(x, y, times) * (x * x + y * y); }, 0);
        if (model.rounds)
            common_.gradient = common_.over_frequencies(
            [](double x, double y, double) {
                const double along = std::sin(PI * x), down = std::sin(PI * y);
                return 4 * (along * along + down * down) + 1e-12;
            },
            1);
        std::fill(result, result + size_t(light_.height) * light_.width * light_.channels, 0.0f);
        // Tiles that do not touch go together. So every pixel is added up in the same order, whatever the threads.
        for (const int phase : {0, 1, 2, 3}) {
            const int top = phase / 2, left = phase % 2;
            const int rows = (tiles_.rows - top + 1) / 2, columns = (tiles_.columns - left + 1) / 2;
            in_parallel(rows * columns, threads_, [&](int i) {
                std::unique_ptr<Room> room = take();
                filter_tile(top + 2 * (i / columns), left + 2 * (i % columns), model, *room, result);
                give(std::move(room));
            });
        }
    }

    std::vector<float> noise(float above, float share, int every) {
        common_.high = common_.over_frequencies(
            [&](double x, double y, double times) {
                return x * x + y * y > double(above) * above ? times : 0.0;
            },
            0);
        const int rows = (tiles_.rows + every - 1) / every, columns = (tiles_.columns + every - 1) / every;
        std::vector<float> found(size_t(light_.channels) * rows * columns * 3);
        in_parallel(rows * columns, threads_, [&](int i) {
            std::unique_ptr<Room> room = take();
            const int row = every * (i / columns), column = every * (i % columns);
            find_transfer(row, column, *room);
            for (int channel = 0; channel < light_.channels; ++channel) {
                const float mean = load_tile(row, column, channel, *room);
                double sums[2];
                simd_.quiet(common_.count, room->transfer, room->spectrum, common_.high.get(), share * share, sums);
                float *out = found.data() + (size_t(channel) * rows * columns + i) * 3;
                out[0] = mean;
                out[1] = sums[1] > 0 ? float(sums[0] / sums[1] / common_.window_power) : 0.0f;
                out[2] = float(sums[1]);
            }
            give(std::move(room));
        });
        return found;
    }

  private:
    // Rooms are used again: to make one takes as long as to filter a tile.
    std::unique_ptr<Room> take() {
        {
            const std::lock_guard<std::mutex> guard(lock_);
            if (!rooms_.empty()) {
                std::unique_ptr<Room> room = std::move(rooms_.back());
                rooms_.pop_back();
                return room;
            }
        }
        return std::make_unique<Room>(common_, tiles_.samples);
    }

    void give(std::unique_ptr<Room> room) {
        const std::lock_guard<std::mutex> guard(lock_);
        rooms_.push_back(std::move(room));
    }

    void find_transfer(int row, int column, Room &room) const {
        const int samples = tiles_.samples;
        const float *path = tiles_.paths + (size_t(row) * tiles_.columns + column) * samples * 2;
        simd_.turns(common_.square, samples, path, room.angles.get(), room.cos_x.get(), room.sin_x.get(),
                    room.cos_y.get(), room.sin_y.get());
        simd_.transfer(common_.square, samples, room.cos_x.get(), room.sin_x.get(), room.cos_y.get(), room.sin_y.get(),
                       room.transfer);
    }

    // How uncertain the transfer is. The mean over the path, weighted by the time since the middle of the exposure, is
    // how it changes with the chord. Takes what `find_transfer` left. Whether there is any doubt.
    bool find_doubt(int row, int column, Room &room) const {
        const float *spread = tiles_.spread + (size_t(row) * tiles_.columns + column) * 3;
        if (spread[0] <= 0 && spread[2] <= 0) {
            std::fill_n(room.doubt.get(), common_.count, 0.0f);
            return false;
        }
        const int samples = tiles_.samples;
        for (int x = 0; x <= tiles_.side / 2; ++x)
            for (int k = 0; k < samples; ++k) {
                const float since = (float(k) + 0.5f) / float(samples) - 0.5f;
                room.cos_x[size_t(x) * samples + k] *= since;
                room.sin_x[size_t(x) * samples + k] *= since;
            }
        simd_.transfer(common_.square, samples, room.cos_x.get(), room.sin_x.get(), room.cos_y.get(), room.sin_y.get(),
                       room.lean);
        simd_.doubt(common_.square, room.lean, common_.vertical.get(), spread[0], spread[1], spread[2],
                    room.doubt.get());
        return true;
    }

    // Transforms a tile, without its mean and windowed; returns the mean.
    float load_tile(int row, int column, int channel, Room &room) const {
        const int side = tiles_.side, pitch = common_.square.pitch;
        const int first_y = row * tiles_.hop - tiles_.before, first_x = column * tiles_.hop - tiles_.before;
        const bool inside = light_.channels == 1 && first_x >= 0 && first_x + side <= light_.width;
        const int *columns = columns_of_.data() + column * tiles_.hop;
        const int begin = std::min(std::max(-first_x, 0), side), end = std::max(std::min(light_.width - first_x, side), begin);
        float *sums = room.scratch.get(), *line = sums + side;
        std::fill_n(sums, side, 0.0f);
        for (int y = 0; y < side; ++y) {
            const float *from =
                light_.values + size_t(mirrored(first_y + y, light_.height)) * light_.width * light_.channels;
            if (inside)
                from += first_x;
            else {
                for (int x = 0; x < begin; ++x) line[x] = from[columns[x] + channel];
                for (int x = begin; x < end; ++x) line[x] = from[(first_x + x) * light_.channels + channel];
                for (int x = end; x < side; ++x) line[x] = from[columns[x] + channel];
                from = line;
            }
            simd_.take(side, from, room.tile.get() + size_t(y) * pitch, sums);
        }
        const float mean = float(std::accumulate(sums, sums + side, 0.0) / (double(side) * side));
        simd_.fade(common_.square, mean, tiles_.window_in, room.tile.get());
        simd_.forward(common_.square, common_.twiddles.data(), room.tile.get(), room.spectrum, room.scratch.get());
        return mean;
    }

    void filter_tile(int row, int column, const Model &model, Room &room, float *result) const {
        const Square &square = common_.square;
        const float *twiddles = common_.twiddles.data();
        const size_t count = common_.count;
        const float scale = 1.0f / (float(square.side) * float(square.side));
        find_transfer(row, column, room);
        const bool doubtful = find_doubt(row, column, room);
        for (int channel = 0; channel < light_.channels; ++channel) {
            const float mean = load_tile(row, column, channel, room);
            const float *line = model.noise + 2 * channel;
            const float noise = std::max(line[0] + line[1] * mean, model.least_noise * model.least_noise);
            double sums[3];
            simd_.fit(square, common_.reach, room.transfer, room.doubt.get(), room.spectrum, common_.fitted.get(),
                      common_.band.get(), sums);
            const double excess = sums[0] / common_.window_power - double(noise) * sums[1];
            const float signal = std::max(float(excess / std::max(sums[2], 1e-30)), model.least_signal * noise);
            const float unlike = model.noise_factor * noise / signal;
            if (model.rounds)
                simd_.correlate(count, room.transfer, room.doubt.get(), room.spectrum, room.power.get(), room.data);
            // (a column of zeros beside the spectrum has a power of zero, and a prior of one)
            simd_.restore(count, room.transfer, room.doubt.get(), common_.flattened.get(), unlike, scale, room.spectrum);
            if (doubtful && model.rounds)
                simd_.weigh(count, room.doubt.get(), common_.flattened.get(), unlike, room.power.get(), room.data);
            const auto back = [&](bool last) {
                simd_.inverse(square, twiddles, room.spectrum, last ? first_ : 0, last ? columns_ : square.side / 2,
                              room.tile.get(), room.scratch.get());
            };
            back(model.rounds == 0);
            for (int round = 0; round < model.rounds; ++round) {
                const float splitting = model.splitting[round];
                const float threshold = 2.0f * std::pow(2.0f / 3.0f / splitting, 0.75f);
                simd_.shrink(square, room.tile.get(), splitting, threshold, room.other.get(), room.scratch.get());
                simd_.forward(square, twiddles, room.other.get(), room.spectrum, room.scratch.get());
                simd_.blend(count, room.data, room.power.get(), common_.gradient.get(),
                            splitting * noise / (model.data_weight * 1e-4f), scale, room.spectrum);
                back(round == model.rounds - 1);
            }
            add(row, column, channel, mean, room, result);
        }
    }

    // Shares of a tile: nothing lies beyond the first and the last one, with which they would be blended.
    const float *shares(int place, int count) const {
        return shares_[(place == 0 ? 1 : 0) + (place == count - 1 ? 2 : 0)].data();
    }

    void add(int row, int column, int channel, float mean, const Room &room, float *result) const {
        const float *down = shares(row, tiles_.rows), *along = shares(column, tiles_.columns);
        const int first_y = row * tiles_.hop - tiles_.before, first_x = column * tiles_.hop - tiles_.before;
        const int from_x = std::max(begin_, -first_x), to_x = std::min(end_, light_.width - first_x);
        for (int y = std::max(begin_, -first_y); y < std::min(end_, light_.height - first_y); ++y) {
            const float weight = down[y];
            const float *from = room.tile.get() + size_t(y) * common_.square.pitch;
            float *out = result + (size_t(first_y + y) * light_.width + first_x) * light_.channels + channel;
            if (light_.channels == 1)
                simd_.add(to_x - from_x, weight, mean, along + from_x, from + from_x, out + from_x);
            else
                for (int x = from_x; x < to_x; ++x) out[x * light_.channels] += weight * along[x] * (from[x] + mean);
        }
    }

    Light light_;
    Tiles tiles_;
    const PathSimd &simd_;
    int threads_, width_, begin_, end_, first_, columns_;
    std::vector<float> shares_[4];
    std::vector<int> columns_of_;
    Common common_;
    std::mutex lock_;
    std::vector<std::unique_ptr<Room>> rooms_;
};

}  // namespace

std::vector<float> twiddles_of(int side) {
    std::vector<float> out;
    for (int n = side, radix = 0; n >= 4; n /= radix) {
        radix = n >= 16 ? 16 : 4;
        for (int p = 0; p < n / radix; ++p)
            for (int power = 1; power < radix; ++power) {
                const double angle = -2 * PI * double(p) * power / n;
                out.push_back(float(std::cos(angle)));
                out.push_back(float(std::sin(angle)));
            }
    }
    return out;
}

size_t room_of(const Square &square) {
    return 8 * (size_t(MOST_LANES) * size_t(square.side) + size_t(APART));
}

void filter_along(const Light &light, const Tiles &tiles, const Model &model, float *result, const PathSimd &simd,
                  int threads) {
    Filter(light, tiles, simd, threads).filter(model, result);
}

std::vector<float> noise_along(const Light &light, const Tiles &tiles, float above, float share, int every,
                               const PathSimd &simd, int threads) {
    return Filter(light, tiles, simd, threads).noise(above, share, every);
}
