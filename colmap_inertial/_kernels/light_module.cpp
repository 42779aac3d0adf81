#include "arrays.h"
#include "light.h"

namespace {

template <class Code>
void blend_image(In<Code, 3> image, In<float, 3> light, Of<Code, 3> result, In<float, 2> extent_px, In<float, 2> slope,
                 In<bool, 2> along_y, In<float, 2> fade, In<float, 1> decode, In<float, 1> encode, int saturated,
                 int threads) {
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
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    blend(image.data(), light.data(), result.data(), Image{height, width, int(image.shape(2))}, field, codec, count);
}

template <class Code>
bool find_spoilt_pixels(In<Code, 3> image, Of<uint8_t, 2> spoilt, In<float, 2> extent_px, In<float, 2> slope,
                        In<bool, 2> along_y, In<float, 1> decode, int saturated, int threads) {
    const int height = int(image.shape(0)), width = int(image.shape(1));
    const int ny = (height + CELL - 1) / CELL, nx = (width + CELL - 1) / CELL;
    check(height > 0 && width > 0 && image.shape(2) > 0, "image: empty");
    check(is(spoilt, image.shape(0), image.shape(1)), "spoilt: not one value for each pixel");
    check(is(extent_px, ny, nx) && is(slope, ny, nx) && is(along_y, ny, nx),
          "extent_px, slope, along_y: not one value for each cell");
    check(decode.shape(0) == size_t(1) << (8 * sizeof(Code)), "decode: not one value for each code");
    const Field field{ny, nx, extent_px.data(), slope.data(), along_y.data(), nullptr};
    const Codec codec{decode.data(), nullptr, 0, saturated};
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    return find_spoilt(image.data(), spoilt.data(), Image{height, width, int(image.shape(2))}, field, codec, count);
}

void join_colours(In<float, 2> luma, In<float, 3> lines, Of<float, 3> result, float red, float blue, int threads) {
    const size_t height = luma.shape(0), width = luma.shape(1);
    check(height > 0 && width > 0, "luma: empty");
    check(is(lines, 4, (height + 1) / 2, (width + 1) / 2), "lines: not four planes of half the size");
    check(is(result, height, width, 3), "result: not three channels of luma's shape");
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    ::join(luma.data(), lines.data(), Image{int(height), int(width), 3}, red, blue, result.data(), count);
}

void encode_light(In<float, 1> light, Of<uint8_t, 1> result, In<float, 1> encode) {
    check(is(result, light.shape(0)), "result: not the shape of light");
    check(encode.shape(0) >= 3, "encode: too short");
    const Codec codec{nullptr, encode.data(), int(encode.shape(0)) - 2, 0};
    nb::gil_scoped_release release;
    ::encode(light.data(), light.shape(0), result.data(), codec);
}

template <class Code>
void define_codes(nb::module_ &module) {
    module.def("blend", &blend_image<Code>, nb::arg("image").noconvert(), nb::arg("light").noconvert(),
               nb::arg("result").noconvert(), nb::kw_only(), nb::arg("extent_px").noconvert(),
               nb::arg("slope").noconvert(), nb::arg("along_y").noconvert(), nb::arg("fade").noconvert(),
               nb::arg("decode").noconvert(), nb::arg("encode").noconvert(), nb::arg("saturated"),
               nb::arg("threads") = 0);
    module.def("find_spoilt", &find_spoilt_pixels<Code>, nb::arg("image").noconvert(), nb::arg("spoilt").noconvert(),
               nb::kw_only(), nb::arg("extent_px").noconvert(), nb::arg("slope").noconvert(),
               nb::arg("along_y").noconvert(), nb::arg("decode").noconvert(), nb::arg("saturated"),
               nb::arg("threads") = 0);
}

}  // namespace

NB_MODULE(_light, module) {
    define_codes<uint8_t>(module);
    define_codes<uint16_t>(module);
    module.def("join", &join_colours, nb::arg("luma").noconvert(), nb::arg("lines").noconvert(),
               nb::arg("result").noconvert(), nb::kw_only(), nb::arg("red"), nb::arg("blue"), nb::arg("threads") = 0);
    module.def("encode", &encode_light, nb::arg("light").noconvert(), nb::arg("result").noconvert(), nb::kw_only(),
               nb::arg("encode").noconvert());
}
