#include "arrays.h"
#include "dispatch.h"
#include "path.h"

#include <algorithm>

namespace {

const Tables<PathSimd> SIMD_TABLES = TABLES_OF(path_simd);

void check_side(size_t side) {
    check(side >= 32 && side <= 8192 && (side & (side - 1)) == 0, "side: must be a power of two from 32 to 8192");
}

Tiles tiles_of(const In<float, 4> &paths, const float *spread, const In<float, 1> &window_in,
               const In<float, 1> &window_out, int hop, int before) {
    check_side(window_in.shape(0));
    check(window_out.shape(0) == window_in.shape(0), "window_out: not of a tile's side");
    const int side = int(window_in.shape(0));
    // tiles of one phase must not touch where they count
    int first = 0, last = side;
    while (first < side && window_out.data()[first] == 0) ++first;
    while (last > first && window_out.data()[last - 1] == 0) --last;
    check(paths.size() > 0 && paths.shape(3) == 2, "paths: not one path for each tile");
    check(hop > 0 && before >= 0 && last - first <= 2 * hop, "hop: too short for the window");
    return {int(paths.shape(0)), int(paths.shape(1)), side,           hop, before, int(paths.shape(2)), paths.data(),
            spread,              window_in.data(),     window_out.data()};
}

Light light_of(const In<float, 3> &light) {
    check(light.size() > 0, "light: empty");
    return {int(light.shape(0)), int(light.shape(1)), int(light.shape(2)), light.data()};
}

void filter(In<float, 3> light, Of<float, 3> result, In<float, 4> paths, In<float, 3> spread, In<float, 1> window_in,
            In<float, 1> window_out, int hop, int before, In<float, 2> noise, float least_noise, float noise_factor,
            float flat_below, float fitted_from, float fitted_to, float least_signal, float data_weight,
            In<float, 1> splitting, int threads, const std::string &instruction_set) {
    const Light source = light_of(light);
    check(is(result, light.shape(0), light.shape(1), light.shape(2)), "result: not the shape of light");
    check(is(noise, light.shape(2), 2), "noise: not two values for each channel");
    check(least_noise > 0 && noise_factor > 0 && data_weight > 0, "least_noise, noise_factor, data_weight: positive");
    check(is(spread, paths.shape(0), paths.shape(1), 3), "spread: not three values for each tile");
    const Tiles tiles = tiles_of(paths, spread.data(), window_in, window_out, hop, before);
    const Model model{noise_factor, flat_below,  fitted_from,
                      fitted_to,    least_signal, least_noise,
                      noise.data(), data_weight, int(splitting.shape(0)),
                      splitting.data()};
    const PathSimd &simd = SIMD_TABLES.require(instruction_set);
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    filter_along(source, tiles, model, result.data(), simd, count);
}

std::vector<float> noise(In<float, 3> light, In<float, 4> paths, In<float, 1> window_in, int hop, int before,
                         float above, float share, int every, int threads, const std::string &instruction_set) {
    const Light source = light_of(light);
    check(every > 0, "every: positive");
    // nothing is put together: any window does for the check
    const Tiles tiles = tiles_of(paths, nullptr, window_in, window_in, std::max(hop, int(window_in.shape(0))), before);
    Tiles placed = tiles;
    placed.hop = hop;
    check(hop > 0, "hop: positive");
    const PathSimd &simd = SIMD_TABLES.require(instruction_set);
    const int count = threads_or_all(threads);
    nb::gil_scoped_release release;
    return noise_along(source, placed, above, share, every, simd, count);
}

// For tests: a tile to its spectrum, (side, side / 2 + 1, 2), and back.
void transform(In<float, 2> tile, Of<float, 3> spectrum, Of<float, 2> back, const std::string &instruction_set) {
    const int side = int(tile.shape(0));
    check_side(tile.shape(0));
    check(is(tile, side, side) && is(back, side, side) && is(spectrum, side, side / 2 + 1, 2), "not of one side");
    const PathSimd &simd = SIMD_TABLES.require(instruction_set);
    const Square square{side, side + 16, side / 2 + 16};
    std::vector<float> pixels(size_t(side) * square.pitch), re(size_t(side) * square.half), im(re.size()),
        room(room_of(square));
    const std::vector<float> twiddles = twiddles_of(side);
    for (int y = 0; y < side; ++y)
        std::copy_n(tile.data() + size_t(y) * side, side, pixels.begin() + ptrdiff_t(y) * square.pitch);
    simd.forward(square, twiddles.data(), pixels.data(), {re.data(), im.data()}, room.data());
    for (int x = 0; x < side; ++x)
        for (int y = 0; y <= side / 2; ++y) {
            float *out = spectrum.data() + (size_t(x) * (side / 2 + 1) + y) * 2;
            out[0] = re[size_t(x) * square.half + y];
            out[1] = im[size_t(x) * square.half + y];
        }
    simd.inverse(square, twiddles.data(), {re.data(), im.data()}, 0, side / 2, pixels.data(), room.data());
    for (int y = 0; y < side; ++y)
        std::copy_n(pixels.begin() + ptrdiff_t(y) * square.pitch, side, back.data() + size_t(y) * side);
}

}  // namespace

NB_MODULE(_path, module) {
    module.def("filter", &filter, nb::arg("light").noconvert(), nb::arg("result").noconvert(), nb::kw_only(),
               nb::arg("paths").noconvert(), nb::arg("spread").noconvert(), nb::arg("window_in").noconvert(),
               nb::arg("window_out").noconvert(),
               nb::arg("hop"), nb::arg("before"), nb::arg("noise").noconvert(), nb::arg("least_noise"),
               nb::arg("noise_factor"), nb::arg("flat_below"), nb::arg("fitted_from"), nb::arg("fitted_to"),
               nb::arg("least_signal"), nb::arg("data_weight"), nb::arg("splitting").noconvert(),
               nb::arg("threads") = 0, nb::arg("instruction_set") = "");
    module.def("noise", &noise, nb::arg("light").noconvert(), nb::kw_only(), nb::arg("paths").noconvert(),
               nb::arg("window_in").noconvert(), nb::arg("hop"), nb::arg("before"), nb::arg("above"), nb::arg("share"),
               nb::arg("every"), nb::arg("threads") = 0, nb::arg("instruction_set") = "");
    module.def("transform", &transform, nb::arg("tile").noconvert(), nb::arg("spectrum").noconvert(),
               nb::arg("back").noconvert(), nb::arg("instruction_set") = "");
    module.def("instruction_sets", [] { return SIMD_TABLES.names(); });
}
