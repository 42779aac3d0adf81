#include "apertures.h"

#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <limits>
#include <mutex>
#include <thread>
#include <vector>

namespace {

// Room around rows, for windows that reach beyond them and vectors that end beyond them.
constexpr int MARGIN = 64;

// Columns of one view and candidate: where in the view, and which stretches of them are an equal distance apart.
struct Stretch {
    int begin, end;  // columns of the reference
    int start, part;  // where `begin` lies in the view: pixel and sixteenths
};
struct Columns {
    int begin = 0, end = 0;  // those that the view has
    std::vector<Stretch> stretches;

    Columns(const int32_t *at, int width, int view_width) {
        const int32_t last = 16 * (view_width - 1);
        bool open = false;
        for (int x = 0; x < width; ++x) {
            const int32_t position = std::clamp(at[x], 0, last);
            if (position == at[x]) {
                if (begin == end) begin = x;
                end = x + 1;
            }
            if (open && position == std::clamp(at[x - 1], 0, last) + 16) {
                stretches.back().end = x + 1;
            } else {
                stretches.push_back({x, x + 1, position / 16, position % 16});
                open = true;
            }
        }
    }
};

int padded(int candidates) { return (candidates + PADDING - 1) / PADDING * PADDING; }

int clamped(int value, int size) { return std::clamp(value, 0, size - 1); }

// Costs of a band of rows. Warped rows are kept while a census window needs them.
class Band {
   public:
    Band(const CostInput &input, const ApertureSimd &simd, const std::vector<Columns> &columns)
        : in_(input),
          simd_(simd),
          columns_(columns),
          reach_(input.tables ? 0 : input.radius),
          window_(2 * reach_ + 1),
          pitch_((input.sides.width + 63) / 64 * 64 + 2 * MARGIN),
          neighbours_(window_ * window_ - 1),
          warped_(size_t(input.sides.views) * input.sides.candidates * window_ * pitch_),
          reference_(size_t(window_) * pitch_),
          bits_(size_t(2 * neighbours_) * pitch_),
          blended_(size_t(input.sides.view_width) + 1),
          mismatches_(size_t(pitch_)),
          sum_(size_t(pitch_)),
          seen_(size_t(pitch_)),
          residual_(size_t(pitch_)),
          costs_(size_t(input.sides.candidates) * pitch_) {}

    void run(int begin, int end, uint8_t *cost) {
        const auto [height, width, candidates, views, view_height, view_width] = in_.sides;
        int ready = std::max(0, begin - reach_);
        for (int y = begin; y < end; ++y) {
            for (; ready <= std::min(height - 1, y + reach_); ++ready) {
                copy_reference(ready);
                for (int k = 0; k < views; ++k)
                    for (int d = 0; d < candidates; ++d) warp(k, d, ready);
            }
            const uint8_t *rows[7];
            if (!in_.tables) {
                for (int r = 0; r < window_; ++r) rows[r] = reference_row(clamped(y + r - reach_, height));
                simd_.census_bits(rows, pitch_, reach_, in_.least, width, bits_.data());
            }
            for (int d = 0; d < candidates; ++d) add_up(y, d);
            simd_.turn(costs_.data(), pitch_, candidates, width, cost + size_t(y) * width * candidates);
        }
    }

   private:
    uint8_t *warped_row(int k, int d, int y) {
        return warped_.data() + ((size_t(k) * in_.sides.candidates + d) * window_ + y % window_) * pitch_ + MARGIN;
    }
    uint8_t *reference_row(int y) { return reference_.data() + size_t(y % window_) * pitch_ + MARGIN; }

    void extend(uint8_t *row) const {
        std::memset(row - reach_, row[0], reach_);
        std::memset(row + in_.sides.width, row[in_.sides.width - 1], reach_);
    }

    void copy_reference(int y) {
        uint8_t *row = reference_row(y);
        std::memcpy(row, in_.reference + size_t(y) * in_.sides.width, in_.sides.width);
        extend(row);
    }

    void warp(int k, int d, int y) {
        const auto [height, width, candidates, views, view_height, view_width] = in_.sides;
        const size_t plane = size_t(k) * candidates + d;
        const int position = std::clamp(in_.rows[plane * height + y], 0, 16 * (view_height - 1));
        const int upper = position / 16, part = position % 16, lower = std::min(upper + 1, view_height - 1);
        const uint8_t *view = in_.views + size_t(k) * view_height * view_width;
        simd_.blend_rows(view + size_t(upper) * view_width, view + size_t(lower) * view_width, part, view_width,
                         blended_.data());
        blended_[view_width] = blended_[view_width - 1];
        uint8_t *row = warped_row(k, d, y);
        for (const Stretch &s : columns_[plane].stretches)
            simd_.blend_columns(blended_.data() + s.start, s.part, s.end - s.begin, row + s.begin);
        extend(row);
    }

    void add_up(int y, int d) {
        const auto [height, width, candidates, views, view_height, view_width] = in_.sides;
        std::fill_n(sum_.begin(), width, uint16_t(0));
        std::fill_n(seen_.begin(), width, uint8_t(0));
        for (int k = 0; k < views; ++k) {
            const size_t plane = size_t(k) * candidates + d;
            const int position = in_.rows[plane * height + y];
            if (position < 0 || position > 16 * (view_height - 1)) continue;
            if (in_.tables) {
                const uint8_t *table = in_.tables + size_t(k) * 65536, *row = warped_row(k, d, y);
                const uint8_t *reference = reference_row(y);
                for (int x = 0; x < width; ++x) mismatches_[x] = table[256 * reference[x] + row[x]];
            } else {
                const uint8_t *rows[7];
                for (int r = 0; r < window_; ++r) rows[r] = warped_row(k, d, clamped(y + r - reach_, height));
                simd_.census(rows, bits_.data(), pitch_, reach_, width, mismatches_.data());
            }
            const Columns &columns = columns_[plane];
            int first = columns.begin, last = columns.end;
            if (in_.shown) narrow(k, plane, y, first, last);
            simd_.add(mismatches_.data() + first, last - first, sum_.data() + first, seen_.data() + first);
        }
        uint8_t *costs = costs_.data() + size_t(d) * pitch_;
        simd_.divide(sum_.data(), seen_.data(), in_.share, in_.unseen, width, costs);
        if (in_.blend) add_blend(y, d, costs);
    }

    // Of which columns of the reference all of the window lies where the view shows something, with the pixels that its
    // values lie between. Positions of columns that the view has do not fall from left to right.
    void narrow(int k, size_t plane, int y, int &begin, int &end) const {
        const auto [height, width, candidates, views, view_height, view_width] = in_.sides;
        const int32_t *at = in_.columns + plane * width, *shown = in_.shown + 2 * size_t(k) * view_height;
        int left = 0, right = view_width;
        for (int r = clamped(y - reach_, height); r <= clamped(y + reach_, height); ++r) {
            const int position = std::clamp(in_.rows[plane * height + r], 0, 16 * (view_height - 1));
            for (int row : {position / 16, (position + 15) / 16}) {
                left = std::max(left, shown[2 * row]);
                right = std::min(right, shown[2 * row + 1]);
            }
        }
        if (left >= right) {
            end = begin;
            return;
        }
        const int first = int(std::lower_bound(at + begin, at + end, 16 * left) - at);
        const int last = int(std::upper_bound(at + first, at + end, 16 * (right - 1)) - at);
        // what lies beyond the view is its outermost column, what lies beyond the reference its own
        const bool cut_left = first > begin || (begin > 0 && left > 0);
        const bool cut_right = last < end || (end < width && right < view_width);
        begin = first + (cut_left ? reach_ : 0);
        end = std::max(begin, last - (cut_right ? reach_ : 0));
    }

    // The luminance cost: a weighted sum of all views that would be zero.
    void add_blend(int y, int d, uint8_t *costs) {
        const int width = in_.sides.width, views = in_.sides.views;
        std::fill_n(residual_.begin(), width, in_.blend[views + 1]);
        simd_.weigh(reference_row(y), in_.blend[0], width, residual_.data());
        for (int k = 0; k < views; ++k) simd_.weigh(warped_row(k, d, y), in_.blend[k + 1], width, residual_.data());
        simd_.look_up(residual_.data(), seen_.data(), views, in_.blend_table, width, costs);
    }

    const CostInput &in_;
    const ApertureSimd &simd_;
    const std::vector<Columns> &columns_;
    int reach_, window_, pitch_, neighbours_;
    std::vector<uint8_t> warped_, reference_, bits_;
    std::vector<uint16_t> blended_;
    std::vector<uint8_t> mismatches_;
    std::vector<uint16_t> sum_;
    std::vector<uint8_t> seen_;
    std::vector<int32_t> residual_;
    std::vector<uint8_t> costs_;
};

// Runs the same work with 0 .. count - 1, in as many threads; what one throws is thrown again here.
template <class Work>
void in_threads(int count, const Work &work) {
    std::vector<std::exception_ptr> failed(count);
    auto guarded = [&](int i) {
        try {
            work(i);
        } catch (...) {
            failed[i] = std::current_exception();
        }
    };
    std::vector<std::thread> threads;
    for (int i = 1; i < count; ++i) threads.emplace_back(guarded, i);
    guarded(0);
    for (std::thread &thread : threads) thread.join();
    for (const std::exception_ptr &error : failed)
        if (error) std::rethrow_exception(error);
}

// Half of the paths: those that arrive from above and from the left, or in mirrored order the others.
class Sweep {
   public:
    Sweep(const Sides &sides, const uint8_t *cost, const uint8_t *guide, int small, const uint16_t *jump,
          const ApertureSimd &simd, bool mirrored, uint16_t *total)
        : sides_(sides),
          cost_(cost),
          guide_(guide),
          small_(small),
          jump_(jump),
          simd_(simd),
          mirrored_(mirrored),
          total_(total),
          padded_(padded(sides.candidates)),
          slot_(padded_ + PADDING),
          paths_(size_t(3 * sides.width + 2) * slot_ + PADDING, BEYOND),
          least_(size_t(3 * sides.width + 2)),
          nothing_(size_t(padded_ + 2 * PADDING)),
          here_(size_t(padded_), BEYOND) {}

    // Rows begin .. end - 1 in the order of the sweep.
    void run(int begin, int end, bool add) {
        const int height = sides_.height, width = sides_.width, candidates = sides_.candidates;
        for (int i = begin; i < end; ++i) {
            const int y = mirrored_ ? height - 1 - i : i, back = mirrored_ ? 1 : -1;
            for (int j = 0; j < width; ++j) {
                const int x = mirrored_ ? width - 1 - j : j;
                const size_t pixel = size_t(y) * width + x;
                const uint8_t *cost = cost_ + pixel * candidates;
                for (int d = 0; d < candidates; ++d) here_[d] = cost[d];
                // A diagonal keeps its slot from row to row, and so does a column: all are updated in place.
                const int slots[4] = {(j - i % width + width) % width, width + j, 2 * width + (j + i) % width,
                                      3 * width + j % 2};
                const int before[4] = {slots[0], slots[1], slots[2], 3 * width + (j + 1) % 2};
                const ptrdiff_t from[4] = {back * (width + 1), back * width, back * (width - 1), back};
                const bool starts[4] = {i == 0 || j == 0, i == 0, i == 0 || j == width - 1, j == 0};
                Step steps[4];
                uint16_t *after[4], least[4];
                for (int p = 0; p < 4; ++p) {
                    after[p] = at(slots[p]);
                    if (starts[p]) {
                        steps[p] = {nothing_.data() + PADDING, 0, 0};
                    } else {
                        const int change = std::abs(int(guide_[pixel]) - int(guide_[ptrdiff_t(pixel) + from[p]]));
                        steps[p] = {at(before[p]), least_[before[p]], jump_[change]};
                    }
                }
                simd_.advance(here_.data(), padded_, small_, steps, 4, after, least, total_ + pixel * padded_, add);
                for (int p = 0; p < 4; ++p) least_[slots[p]] = least[p];
            }
        }
    }

   private:
    uint16_t *at(int slot) { return paths_.data() + size_t(slot) * slot_ + PADDING; }

    const Sides &sides_;
    const uint8_t *cost_, *guide_;
    int small_;
    const uint16_t *jump_;
    const ApertureSimd &simd_;
    bool mirrored_;
    uint16_t *total_;
    int padded_, slot_;
    std::vector<uint16_t> paths_, least_, nothing_, here_;
};

}  // namespace

void matching_cost(const CostInput &input, const ApertureSimd &simd, int threads, uint8_t *cost) {
    const int height = input.sides.height, width = input.sides.width;
    std::vector<Columns> columns;
    for (int plane = 0; plane < input.sides.views * input.sides.candidates; ++plane)
        columns.emplace_back(input.columns + size_t(plane) * width, width, input.sides.view_width);
    const int bands = std::clamp(threads, 1, height);
    in_threads(bands, [&](int i) {
        Band(input, simd, columns).run(int(int64_t(height) * i / bands), int(int64_t(height) * (i + 1) / bands), cost);
    });
}

void semi_global(const Sides &sides, const uint8_t *cost, const uint8_t *guide, int small, const uint16_t *jump,
                 const ApertureSimd &simd, int threads, uint16_t *total) {
    Sweep down(sides, cost, guide, small, jump, simd, false, total);
    Sweep up(sides, cost, guide, small, jump, simd, true, total);
    const int height = sides.height, middle = height / 2;
    if (threads < 2 || height < 2) {
        down.run(0, height, false);
        up.run(0, height, true);
        return;
    }
    // Two sweeps towards each other: each is the first in its half of the rows, and the second in the other's.
    std::mutex mutex;
    std::condition_variable met;
    int arrived = 0;
    in_threads(2, [&](int i) {
        Sweep &sweep = i == 0 ? down : up;
        const int own = i == 0 ? middle : height - middle;
        sweep.run(0, own, false);
        std::unique_lock lock(mutex);
        if (++arrived == 2) met.notify_all();
        met.wait(lock, [&] { return arrived == 2; });
        lock.unlock();
        sweep.run(own, height, true);
    });
}

void winners(const Sides &sides, const uint16_t *total, int threads, uint16_t *least, uint16_t *index, float *aside) {
    const int candidates = sides.candidates, bands = std::clamp(threads, 1, sides.height);
    const size_t pixels = size_t(sides.height) * sides.width;
    in_threads(bands, [&](int band) {
        for (size_t i = pixels * band / bands; i < pixels * (band + 1) / bands; ++i) {
            const uint16_t *at = total + i * padded(candidates);
            const int best = int(std::min_element(at, at + candidates) - at);
            least[i] = at[best];
            index[i] = uint16_t(best);
            aside[i] = 0;
            if (best == 0 || best == candidates - 1) continue;
            const int before = at[best - 1], here = at[best], after = at[best + 1];
            const int bend = before - 2 * here + after;
            if (bend > 0) aside[i] = float(before - after) / float(2 * bend);
        }
    });
}

void visibility(const Sides &sides, const float *disparity, const uint16_t *least, const double *ratios, double cx,
                double cy, float tolerance, int threads, uint8_t *bits) {
    const int height = sides.height, width = sides.width;
    const size_t pixels = size_t(height) * width;
    const int workers = std::clamp(threads, 1, sides.views);
    in_threads(workers, [&](int worker) {
        struct Cheapest {
            uint16_t total;
            float disparity;
        };
        std::vector<float> nearest(pixels);
        std::vector<Cheapest> cheapest(pixels);
        for (int k = worker; k < sides.views; k += workers) {
            const double *ratio = ratios + 3 * k;
            // calls back with every pixel's disparity and place in the view, where it has one
            auto each = [&](auto &&visit) {
                for (int y = 0; y < height; ++y)
                    for (int x = 0; x < width; ++x) {
                        const size_t pixel = size_t(y) * width + x;
                        const double d = disparity[pixel], size = 1 - d * ratio[2];
                        const double u = (x - cx - d * ratio[0]) / size + cx, v = (y - cy - d * ratio[1]) / size + cy;
                        if (u > -0.5 && v > -0.5 && u < width - 0.5 && v < height - 0.5) visit(pixel, u, v);
                    }
            };
            auto rounded = [&](double u, double v) { return size_t(int(v + 0.5)) * width + size_t(int(u + 0.5)); };
            std::fill(nearest.begin(), nearest.end(), -std::numeric_limits<float>::infinity());
            std::fill(cheapest.begin(), cheapest.end(), Cheapest{65535, 0});
            each([&](size_t pixel, double u, double v) {
                const float d = disparity[pixel];
                const int left = int(std::floor(u)), upper = int(std::floor(v));
                for (int j = std::max(0, upper); j <= std::min(height - 1, upper + 1); ++j)
                    for (int i = std::max(0, left); i <= std::min(width - 1, left + 1); ++i) {
                        float &there = nearest[size_t(j) * width + i];
                        there = std::max(there, d);
                    }
                Cheapest &there = cheapest[rounded(u, v)];
                if (least[pixel] < there.total) there = {least[pixel], d};
            });
            uint8_t *seen = bits + k * pixels;
            std::fill_n(seen, pixels, uint8_t(0));
            each([&](size_t pixel, double u, double v) {
                const float d = disparity[pixel];
                const size_t there = rounded(u, v);
                seen[pixel] = uint8_t((d >= nearest[there] - tolerance ? 1 : 0) |
                                      (std::abs(d - cheapest[there].disparity) <= tolerance ? 2 : 0));
            });
        }
    });
}
