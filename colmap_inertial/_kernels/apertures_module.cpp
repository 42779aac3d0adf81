#include "arrays.h"
#include "apertures.h"
#include "dispatch.h"

#include <nanobind/stl/optional.h>

#include <optional>

namespace {

Tables<ApertureSimd> simd_tables() {
    Tables<ApertureSimd> tables = TABLES_OF(apertures);
#if defined(COLMAP_INERTIAL_X86_64)
    // sums of bytes and words need more of AVX-512 than its foundation
    __builtin_cpu_init();
    if (!__builtin_cpu_supports("avx512bw")) tables.avx512 = nullptr;
#endif
    return tables;
}

const Tables<ApertureSimd> SIMD_TABLES = simd_tables();

int padded(int candidates) { return (candidates + PADDING - 1) / PADDING * PADDING; }

void matching_costs(In<uint8_t, 2> reference, In<uint8_t, 3> views, In<int32_t, 3> columns, In<int32_t, 3> rows,
                    Of<uint8_t, 3> cost, In<int32_t, 1> share, int unseen, int radius,
                    int least, std::optional<In<uint8_t, 3>> tables, std::optional<In<int32_t, 1>> blend,
                    std::optional<In<uint8_t, 1>> blend_table, std::optional<In<int32_t, 3>> shown, int threads,
                    const std::string &instruction_set) {
    const Sides sides{int(reference.shape(0)), int(reference.shape(1)), int(cost.shape(2)),
                      int(views.shape(0)),     int(views.shape(1)),     int(views.shape(2))};
    const int height = sides.height, width = sides.width, count = sides.views, candidates = sides.candidates;
    check(height > 0 && width > 0 && count > 0 && candidates > 0 && views.size() > 0, "empty");
    check(is(columns, count, candidates, width) && is(rows, count, candidates, height),
          "columns, rows: not one position for each view, candidate and pixel");
    check(is(cost, height, width, candidates), "cost: not of the reference's size");
    check(share.shape(0) == size_t(count) + 1, "share: not one value for each number of views");
    check(count <= 255, "views: at most 255");
    for (int i = 0; i <= count; ++i)
        check(share.data()[i] >= 0 && share.data()[i] <= 32768, "share: must be from 0 to 32768");
    check(unseen >= 0 && unseen <= 255, "unseen: must be from 0 to 255");
    check(radius >= 1 && radius <= 3, "radius: must be from 1 to 3");
    check(least >= 0 && least <= 255, "least: must be from 0 to 255");
    check(!tables || is(*tables, count, 256, 256), "tables: not one of 256 x 256 for each view");
    check(blend.has_value() == blend_table.has_value(), "blend and blend_table belong together");
    check(!blend || (blend->shape(0) == size_t(count) + 2 && blend_table->shape(0) == 256),
          "blend, blend_table: of other lengths");
    check(!shown || is(*shown, count, sides.view_height, 2), "shown: not a range for each row of each view");
    for (size_t i = 0; shown && i < shown->size(); i += 2)
        check(shown->data()[i] >= 0 && shown->data()[i] <= shown->data()[i + 1] &&
                  shown->data()[i + 1] <= sides.view_width,
              "shown: not a range of columns");
    const CostInput input{sides,
                          reference.data(),
                          views.data(),
                          columns.data(),
                          rows.data(),
                          radius,
                          least,
                          tables ? tables->data() : nullptr,
                          share.data(),
                          unseen,
                          blend ? blend->data() : nullptr,
                          blend_table ? blend_table->data() : nullptr,
                          shown ? shown->data() : nullptr};
    const ApertureSimd &simd = SIMD_TABLES.require(instruction_set);
    nb::gil_scoped_release release;
    matching_cost(input, simd, threads_or_all(threads), cost.data());
}

void semi_global_matching(In<uint8_t, 3> cost, In<uint8_t, 2> guide, int small, In<uint16_t, 1> jump,
                          Of<uint16_t, 3> total, int threads, const std::string &instruction_set) {
    const Sides sides{int(cost.shape(0)), int(cost.shape(1)), int(cost.shape(2)), 0, 0, 0};
    const int height = sides.height, width = sides.width, candidates = sides.candidates;
    check(height > 0 && width > 0 && candidates > 0, "cost: empty");
    check(is(guide, height, width), "guide: not of the cost's size");
    check(is(total, height, width, padded(candidates)), "total: not of the cost's size, candidates padded");
    check(jump.shape(0) == 256, "jump: not one penalty for each difference of codes");
    check(small >= 0 && small <= 4000, "small: must be from 0 to 4000");
    for (int i = 0; i < 256; ++i) check(jump.data()[i] <= 4000, "jump: must be at most 4000");
    const ApertureSimd &simd = SIMD_TABLES.require(instruction_set);
    nb::gil_scoped_release release;
    semi_global(sides, cost.data(), guide.data(), small, jump.data(), simd, threads_or_all(threads), total.data());
}

void winners_of(In<uint16_t, 3> total, Of<uint16_t, 2> least, Of<uint16_t, 2> index, Of<float, 2> aside,
                int candidates, int threads) {
    const Sides sides{int(index.shape(0)), int(index.shape(1)), candidates, 0, 0, 0};
    check(candidates > 0 && is(total, sides.height, sides.width, padded(candidates)), "total: not of the index's size");
    check(is(least, sides.height, sides.width) && is(aside, sides.height, sides.width),
          "least, aside: not of the index's size");
    nb::gil_scoped_release release;
    winners(sides, total.data(), threads_or_all(threads), least.data(), index.data(), aside.data());
}

void visible(In<float, 2> disparity, In<uint16_t, 2> least, In<double, 2> ratios, double cx, double cy,
             float tolerance, Of<uint8_t, 3> bits, int threads) {
    const Sides sides{int(disparity.shape(0)), int(disparity.shape(1)), 0, int(ratios.shape(0)), 0, 0};
    check(disparity.size() > 0 && ratios.shape(0) > 0 && ratios.shape(1) == 3, "ratios: not three for each view");
    check(is(least, sides.height, sides.width), "least: not of the disparity's size");
    check(is(bits, sides.views, sides.height, sides.width), "bits: not of the disparity's size");
    nb::gil_scoped_release release;
    visibility(sides, disparity.data(), least.data(), ratios.data(), cx, cy, tolerance, threads_or_all(threads),
               bits.data());
}

}  // namespace

NB_MODULE(_apertures, m) {
    using namespace nb::literals;
    m.attr("PADDING") = PADDING;
    m.def("matching_costs", &matching_costs, "reference"_a, "views"_a, nb::kw_only(), "columns"_a, "rows"_a,
          "cost"_a.noconvert(), "share"_a, "unseen"_a, "radius"_a, "least"_a = 0, "tables"_a = nb::none(), "blend"_a = nb::none(),
          "blend_table"_a = nb::none(), "shown"_a = nb::none(), "threads"_a = 0, "instruction_set"_a = "");
    m.def("semi_global", &semi_global_matching, "cost"_a, "guide"_a, nb::kw_only(), "small"_a, "jump"_a,
          "total"_a.noconvert(), "threads"_a = 0, "instruction_set"_a = "");
    m.def("winners", &winners_of, "total"_a, nb::kw_only(), "least"_a.noconvert(), "index"_a.noconvert(),
          "aside"_a.noconvert(), "candidates"_a, "threads"_a = 0);
    m.def("visibility", &visible, "disparity"_a, "least"_a, nb::kw_only(), "ratios"_a, "cx"_a, "cy"_a, "tolerance"_a,
          "bits"_a.noconvert(), "threads"_a = 0);
    m.def("instruction_sets", [] { return SIMD_TABLES.names(); });
}
