#include "arrays.h"
#include "dispatch.h"
#include "wiener.h"

#include <nanobind/stl/pair.h>

#include <chrono>

namespace {

const Tables<Simd> SIMD_TABLES = TABLES_OF(simd);

template <class Code>
std::pair<double, double> deblur_image(In<Code, 3> image, Of<Code, 3> result, In<float, 2> extent_px,
                                       In<float, 2> slope, In<bool, 2> along_y, In<float, 2> fade, In<float, 2> weights,
                                       In<int32_t, 1> reach, float first, float steps, In<float, 1> smoothing,
                                       In<float, 1> decode, In<float, 1> encode, int saturated, int threads,
                                       const std::string &instruction_set) {
    const int height = int(image.shape(0)), width = int(image.shape(1));
    const int ny = (height + CELL - 1) / CELL, nx = (width + CELL - 1) / CELL;
    check(height > 0 && width > 0 && image.shape(2) > 0, "image: empty");
    check(is(result, image.shape(0), image.shape(1), image.shape(2)),
          "result: not the shape of image");
    check(is(extent_px, ny, nx) && is(slope, ny, nx) && is(along_y, ny, nx),
          "extent_px, slope, along_y: not one value for each cell");
    check(is(fade, ny + 1, nx + 1), "fade: not one value for each corner");
    check(weights.shape(0) >= 2 && reach.shape(0) == weights.shape(0) && weights.shape(1) >= 1,
          "weights, reach: not a table");
    for (size_t i = 0; i < reach.shape(0); ++i)
        check(reach.data()[i] >= 0 && size_t(reach.data()[i]) < weights.shape(1), "reach: beyond the weights");
    check(smoothing.shape(0) >= 1 && smoothing.shape(0) <= 1 + MOST_RADIUS, "smoothing: empty, or too wide");
    for (size_t i = 0; i < slope.size(); ++i)
        check(slope.data()[i] >= -1 && slope.data()[i] <= 1, "slope: must be within +-1");
    if constexpr (!std::is_same_v<Code, float>) {
        check(decode.shape(0) == size_t(1) << (8 * sizeof(Code)), "decode: not one value for each code");
        check(encode.shape(0) >= 3, "encode: too short");
    }
    const Field field{ny, nx, extent_px.data(), slope.data(), along_y.data(), fade.data()};
    const Table table{int(weights.shape(0)), int(weights.shape(1)), first, steps, weights.data(), reach.data(),
                      int(smoothing.shape(0)) - 1, smoothing.data()};
    const Codec codec{decode.data(), encode.data(), int(encode.shape(0)) - 2, saturated};
    const Simd &simd = SIMD_TABLES.require(instruction_set);
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    const Seconds seconds = deblur(image.data(), result.data(), Image{height, width, int(image.shape(2))}, field, table,
                                   codec, simd, count);
    return {seconds.decode, seconds.filter};
}

template <class Code>
void blend_image(In<Code, 3> image, In<float, 3> light, Of<Code, 3> result, In<float, 2> extent_px, In<float, 2> slope,
                 In<bool, 2> along_y, In<float, 2> fade, In<float, 1> decode, In<float, 1> encode, int saturated,
                 int threads, const std::string &instruction_set) {
    const int height = int(image.shape(0)), width = int(image.shape(1));
    const int ny = (height + CELL - 1) / CELL, nx = (width + CELL - 1) / CELL;
    check(height > 0 && width > 0 && image.shape(2) > 0, "image: empty");
    check(is(result, image.shape(0), image.shape(1), image.shape(2)) &&
              is(light, image.shape(0), image.shape(1), image.shape(2)),
          "light, result: not the shape of image");
    check(is(extent_px, ny, nx) && is(slope, ny, nx) && is(along_y, ny, nx),
          "extent_px, slope, along_y: not one value for each cell");
    check(is(fade, ny + 1, nx + 1), "fade: not one value for each corner");
    check(decode.shape(0) == size_t(1) << (8 * sizeof(Code)), "decode: not one value for each code");
    check(encode.shape(0) >= 3, "encode: too short");
    const Field field{ny, nx, extent_px.data(), slope.data(), along_y.data(), fade.data()};
    const Codec codec{decode.data(), encode.data(), int(encode.shape(0)) - 2, saturated};
    const Simd &simd = SIMD_TABLES.require(instruction_set);
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    blend(image.data(), light.data(), result.data(), Image{height, width, int(image.shape(2))}, field, codec, simd,
          count);
}

void join_colours(In<float, 2> luma, In<float, 3> lines, Of<float, 3> result, float red, float blue, int threads,
                  const std::string &instruction_set) {
    const size_t height = luma.shape(0), width = luma.shape(1);
    check(height > 0 && width > 0, "luma: empty");
    check(is(lines, 4, (height + 1) / 2, (width + 1) / 2), "lines: not four planes of half the size");
    check(is(result, height, width, 3), "result: not three channels of luma's shape");
    const Simd &simd = SIMD_TABLES.require(instruction_set);
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    ::join(luma.data(), lines.data(), Image{int(height), int(width), 3}, red, blue, result.data(), simd, count);
}

void encode_light(In<float, 1> light, Of<uint8_t, 1> result, In<float, 1> encode, const std::string &instruction_set) {
    check(is(result, light.shape(0)), "result: not the shape of light");
    check(encode.shape(0) >= 3, "encode: too short");
    const Codec codec{nullptr, encode.data(), int(encode.shape(0)) - 2, 0};
    const Simd &simd = SIMD_TABLES.require(instruction_set);
    nb::gil_scoped_release release;
    ::encode(light.data(), light.shape(0), result.data(), codec, simd);
}

// Multiply-adds a second, lanes counted singly, that one core does on numbers in registers: the best of several runs.
double peak_multiply_adds(const std::string &instruction_set, double seconds) {
    const Simd &simd = SIMD_TABLES.require(instruction_set);
    nb::gil_scoped_release release;
    using Clock = std::chrono::steady_clock;
    volatile float sink;
    float value = 0;
    double best = 0;
    const auto begin = Clock::now();
    do {
        const auto start = Clock::now();
        const double count = simd.multiply_adds(200000, &value);
        sink = value;
        best = std::max(best, count / std::chrono::duration<double>(Clock::now() - start).count());
    } while (std::chrono::duration<double>(Clock::now() - begin).count() < seconds);
    (void)sink;
    return best;
}

template <class Code>
void define_blend(nb::module_ &module) {
    module.def("blend", &blend_image<Code>, nb::arg("image").noconvert(), nb::arg("light").noconvert(),
               nb::arg("result").noconvert(), nb::kw_only(), nb::arg("extent_px").noconvert(),
               nb::arg("slope").noconvert(), nb::arg("along_y").noconvert(), nb::arg("fade").noconvert(),
               nb::arg("decode").noconvert(), nb::arg("encode").noconvert(), nb::arg("saturated"),
               nb::arg("threads") = 0, nb::arg("instruction_set") = "");
}

template <class Code>
void define(nb::module_& module) {
    module.def("deblur", &deblur_image<Code>, nb::arg("image").noconvert(), nb::arg("result").noconvert(),
               nb::kw_only(), nb::arg("extent_px").noconvert(), nb::arg("slope").noconvert(),
               nb::arg("along_y").noconvert(), nb::arg("fade").noconvert(), nb::arg("weights").noconvert(),
               nb::arg("reach").noconvert(), nb::arg("first"), nb::arg("steps"), nb::arg("smoothing").noconvert(),
               nb::arg("decode").noconvert(), nb::arg("encode").noconvert(), nb::arg("saturated"),
               nb::arg("threads") = 0, nb::arg("instruction_set") = "");
}

}  // namespace

NB_MODULE(_wiener, module) {
    define<uint8_t>(module);
    define_blend<uint8_t>(module);
    define_blend<uint16_t>(module);
    define<uint16_t>(module);
    define<float>(module);
    module.def("join", &join_colours, nb::arg("luma").noconvert(), nb::arg("lines").noconvert(),
               nb::arg("result").noconvert(), nb::kw_only(), nb::arg("red"), nb::arg("blue"), nb::arg("threads") = 0,
               nb::arg("instruction_set") = "");
    module.def("encode", &encode_light, nb::arg("light").noconvert(), nb::arg("result").noconvert(), nb::kw_only(),
               nb::arg("encode").noconvert(), nb::arg("instruction_set") = "");
    module.def("peak_multiply_adds", &peak_multiply_adds, nb::arg("instruction_set") = "", nb::arg("seconds") = 0.2);
    module.def("instruction_sets", [] { return SIMD_TABLES.names(); });
}
