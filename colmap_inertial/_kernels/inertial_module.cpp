#include "arrays.h"
#include "arrow_simd.h"
#include "dispatch.h"
#include "observations.h"
#include "points_simd.h"
#include "preintegration.h"

#include <nanobind/stl/optional.h>

#include <cmath>
#include <cstdlib>
#include <limits>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <vector>

namespace {

template <int N>
using Doubles = In<double, N>;
template <int N>
using Results = Of<double, N>;

const Tables<ArrowSimd> SIMD_TABLES = TABLES_OF(arrow);
const Tables<PointsSimd> POINTS = TABLES_OF(points);

struct Free {
    void operator()(void *memory) const { std::free(memory); }
};
using Memory = std::unique_ptr<double, Free>;

// On a boundary of cache lines, not initialised.
Memory memory_for(size_t doubles) {
    void *memory = std::aligned_alloc(64, (doubles * sizeof(double) + 63) / 64 * 64 + 64);
    if (!memory) throw std::bad_alloc();
    return Memory(static_cast<double *>(memory));
}

class ArrowFactor {
   public:
    ArrowFactor(const Chain &chain, const ArrowSimd &simd)
        : chain_(chain),
          simd_(simd),
          diagonal_(memory_for(size_t(chain.states * chain.size * padded(chain.size)))),
          right_(memory_for(size_t(chain.states * chain.size * padded(chain.size)))) {}

    Factor factor() const { return {diagonal_.get(), right_.get()}; }

    void substitute(Results<3> sides, bool half_done) const {
        check(is(sides, chain_.states, chain_.size, sides.shape(2)), "sides: not one row for each number of a state");
        Chain chain = chain_;
        chain.sides = ptrdiff_t(sides.shape(2));
        const ptrdiff_t rows = chain.states * chain.size, q = chain.sides, pitch = padded(q);
        double *values = sides.data();
        nb::gil_scoped_release release;
        if (pitch == q) return simd_.substitute(chain, factor(), values, half_done);
        const Memory x = memory_for(size_t(rows * pitch));
        for (ptrdiff_t i = 0; i < rows; ++i)
            for (ptrdiff_t j = 0; j < pitch; ++j) x.get()[i * pitch + j] = j < q ? values[i * q + j] : 0;
        simd_.substitute(chain, factor(), x.get(), half_done);
        for (ptrdiff_t i = 0; i < rows; ++i)
            for (ptrdiff_t j = 0; j < q; ++j) values[i * q + j] = x.get()[i * pitch + j];
    }

    void selected_inverse(Results<3> diagonal, Results<3> right) const {
        const size_t k = size_t(chain_.states), m = size_t(chain_.size);
        check(is(diagonal, k, m, m) && is(right, k - 1, m, m), "diagonal, right: not of the size of the chain");
        double *here = diagonal.data(), *beside = right.data();
        nb::gil_scoped_release release;
        const Memory work = memory_for(simd_.inverse_work(chain_));
        simd_.selected_inverse(chain_, factor(), here, beside, work.get());
    }

   private:
    Chain chain_;  // its sizes
    const ArrowSimd &simd_;
    Memory diagonal_, right_;
};

// Null where the chain is not positive definite.
std::unique_ptr<ArrowFactor> eliminate(const Chain &chain, const ArrowSimd &simd, double *products, double *forward) {
    auto result = std::make_unique<ArrowFactor>(chain, simd);
    const ptrdiff_t n = chain.globals, columns = n + chain.sides, pitch = padded(columns);
    const Memory work = memory_for(simd.work(chain));
    std::vector<double> negative(size_t(n * pitch), 0.0);
    if (!simd.eliminate(chain, result->factor(), negative.data(), forward, work.get())) return nullptr;
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t j = 0; j < columns; ++j)
            products[i * columns + j] = -negative[size_t(j < i ? j * pitch + i : i * pitch + j)];
    return result;
}

ArrowFactor *eliminate_chain(Doubles<3> diagonal, Doubles<3> below, Doubles<3> border, Doubles<3> rhs, Doubles<2> unit,
                             Results<2> products, std::optional<Results<3>> forward,
                             const std::string &instruction_set) {
    const size_t k = border.shape(0), m = border.shape(1), n = border.shape(2), q = rhs.shape(2);
    check(k > 0 && m > 0, "border: empty");
    check(is(diagonal, k, m, m) && is(below, k - 1, m, m) && is(rhs, k, m, q) && is(unit, k, m),
          "diagonal, below, rhs, unit: not of the size of border");
    check(is(products, n, n + q), "products: not (n, n + q)");
    check(!forward || is(*forward, k, m, padded(n + q)), "forward: not (K, m, n + q), padded");
    const ArrowSimd &simd = SIMD_TABLES.require(instruction_set);
    const Chain chain{ptrdiff_t(k), ptrdiff_t(m), ptrdiff_t(n), ptrdiff_t(q), diagonal.data(), below.data(),
                      border.data(), rhs.data(), unit.data()};
    double *values = products.data(), *solved = forward ? forward->data() : nullptr;
    nb::gil_scoped_release release;
    return eliminate(chain, simd, values, solved).release();
}

void add_information(Doubles<3> here, std::optional<Doubles<3>> after, std::optional<Doubles<3>> by_globals,
                     size_t first, size_t column, Results<3> diagonal, Results<3> below, Results<3> border,
                     Results<2> corner, const std::string &instruction_set) {
    const size_t states = here.shape(0), r = here.shape(1), m = here.shape(2);
    const size_t k = border.shape(0), n = border.shape(2), g = by_globals ? by_globals->shape(2) : 0;
    check(k > 0 && is(diagonal, k, m, m) && is(below, k - 1, m, m) && is(border, k, m, n) && is(corner, n, n),
          "diagonal, below, border, corner: not a system with states of the size that here has");
    check(!after || is(*after, states, r, m), "after: not of the size of here");
    check(!by_globals || is(*by_globals, states, r, g), "by_globals: not of the size of here");
    check(first <= k && states + (after ? 1 : 0) <= k - first, "first: beyond the states");
    check(column <= n && g <= n - column, "column: beyond the globals");
    const ArrowSimd &simd = SIMD_TABLES.require(instruction_set);
    if (states == 0) return;
    const double *next = after ? after->data() : nullptr, *globals = by_globals ? by_globals->data() : nullptr;
    const Rows rows{ptrdiff_t(states), ptrdiff_t(r), ptrdiff_t(m), ptrdiff_t(g), here.data(), next, globals};
    const Sums sums{ptrdiff_t(n), diagonal.data() + first * m * m, below.data() + first * m * m,
                    border.data() + first * m * n + column, corner.data() + column * n + column};
    nb::gil_scoped_release release;
    const Memory work = memory_for(simd.rows_work(rows));
    simd.add_rows(rows, sums, work.get());
}

void preintegrate_intervals(Doubles<1> nodes_s, Of<const int64_t, 1> steps, Doubles<1> gyro_t_s, Doubles<2> gyro,
                            Doubles<2> gyro_slope, Doubles<1> accel_t_s, Doubles<2> accel, Doubles<2> accel_slope,
                            Doubles<2> gyro_bias, Doubles<2> accel_bias, Doubles<2> gyro_matrix,
                            Doubles<2> accel_matrix, double accel_delay_s, double delay_step_s, Results<3> rotation,
                            Results<2> velocity, Results<2> position, Results<3> cov_gyro, Results<3> by_gyro_bias,
                            Results<3> by_accel_bias, Results<3> by_gyro_gain, Results<3> by_accel_gain,
                            Results<2> by_accel_delay, Results<2> rate) {
    const size_t k = steps.shape(0), n = gyro_t_s.shape(0), a = accel_t_s.shape(0);
    check(k > 0 && is(nodes_s, k + 1), "nodes_s, steps: not the ends of intervals");
    for (size_t i = 0; i < k; ++i) check(steps.data()[i] > 0, "steps: must be positive");
    check(n > 1 && is(gyro, n, 3) && is(gyro_slope, n, 3), "gyro: not (N, 3), or too short");
    check(a > 1 && is(accel, a, 3) && is(accel_slope, a, 3), "accel: not (N, 3), or too short");
    check(is(gyro_bias, k, 3) && is(accel_bias, k, 3), "gyro_bias, accel_bias: not one for each interval");
    check(is(gyro_matrix, 3, 3) && is(accel_matrix, 3, 3), "gyro_matrix, accel_matrix: not (3, 3)");
    check(is(rotation, k, 3, 3) && is(velocity, k, 3) && is(position, k, 3) && is(cov_gyro, k, 9, 9) &&
              is(by_gyro_bias, k, 9, 3) && is(by_accel_bias, k, 9, 3) && is(by_gyro_gain, k, 9, 9) &&
              is(by_accel_gain, k, 9, 9) && is(by_accel_delay, k, 9) && is(rate, k + 1, 3),
          "results: not of the size of the intervals");
    const Track gyro_track{n, gyro_t_s.data(), gyro.data(), gyro_slope.data()};
    const Track accel_track{a, accel_t_s.data(), accel.data(), accel_slope.data()};
    const Intervals intervals{k,
                              nodes_s.data(),
                              steps.data(),
                              gyro_bias.data(),
                              accel_bias.data(),
                              gyro_matrix.data(),
                              accel_matrix.data(),
                              accel_delay_s,
                              delay_step_s};
    const Increments out{rotation.data(),      velocity.data(),       position.data(),     cov_gyro.data(),
                         by_gyro_bias.data(),  by_accel_bias.data(),  by_gyro_gain.data(), by_accel_gain.data(),
                         by_accel_delay.data(), rate.data()};
    nb::gil_scoped_release release;
    preintegrate(gyro_track, accel_track, intervals, out);
}

// Divides `sides` by the Cholesky factor of a tridiagonal matrix; returns half the logarithm of its determinant.
double whiten_tridiagonal(Doubles<1> diagonal, Doubles<1> below, Results<2> sides) {
    const size_t n = diagonal.shape(0), columns = sides.shape(1);
    check(n > 0 && is(below, n - 1) && is(sides, n, columns), "diagonal, below, sides: not of one size");
    const double *d = diagonal.data(), *b = below.data();
    double *x = sides.data();
    nb::gil_scoped_release release;
    double logarithm = 0, root = 0;
    for (size_t i = 0; i < n; ++i, x += columns) {
        const double left = i > 0 ? b[i - 1] / root : 0, pivot = d[i] - left * left;
        if (!(pivot > 0)) return std::numeric_limits<double>::quiet_NaN();
        root = std::sqrt(pivot);
        logarithm += std::log(root);
        for (size_t c = 0; c < columns; ++c) {
            const double before = i > 0 ? left * *(x + c - columns) : 0;
            x[c] = (x[c] - before) / root;
        }
    }
    return logarithm;
}

// Numbers of places that point into an array.
void check_places(const In<int64_t, 1> &places, size_t count, const char *message) {
    for (size_t i = 0; i < places.shape(0); ++i) check(places(i) >= 0 && size_t(places(i)) < count, message);
}

// See the stub.
void place_points_of(In<int64_t, 1> pose, In<int64_t, 1> point, Doubles<3> world_from_imu, Doubles<2> imu_in_world,
                     Doubles<2> points, Doubles<2> cam_from_imu, Doubles<1> imu_in_cam, Results<2> in_imu,
                     Results<2> in_cam) {
    const size_t m = pose.shape(0), n = imu_in_world.shape(0), p = points.shape(0);
    check(is(point, m) && is(in_imu, m, 3) && is(in_cam, m, 3) && is(world_from_imu, n, 3, 3) &&
              is(imu_in_world, n, 3) && is(points, p, 3) && is(cam_from_imu, 3, 3) && is(imu_in_cam, 3),
          "points: not of one size");
    check_places(pose, n, "pose: not one of them");
    check_places(point, p, "point: not one of them");
    Poses poses{};
    poses.world_from_imu = world_from_imu.data();
    poses.position = imu_in_world.data();
    nb::gil_scoped_release release;
    place_points(poses, {cam_from_imu.data(), imu_in_cam.data()}, m, pose.data(), point.data(), points.data(),
                 in_imu.data(), in_cam.data());
}

// See the stub.
void apply_chain_rule_of(In<int64_t, 1> pose, Doubles<1> since_s, Doubles<2> force, Doubles<2> rate,
                         Doubles<2> reading, Doubles<2> vector, Doubles<3> turn, Doubles<3> world_from_imu,
                         Doubles<2> velocity, Doubles<2> cam_from_imu, Doubles<1> imu_in_cam, Doubles<2> in_imu,
                         Doubles<2> in_cam, Doubles<3> by_cam, Doubles<3> by_intrinsics, Doubles<1> line,
                         Doubles<1> since_middle_s, Doubles<1> weight, Results<3> by_frame, Results<3> by_shared,
                         Results<3> by_point) {
    const size_t m = pose.shape(0), n = since_s.shape(0), k = by_intrinsics.shape(2), q = by_shared.shape(2);
    check(is(force, n, 3) && is(rate, n, 3) && is(reading, n, 3) && is(vector, n, 3) && is(turn, n, 3, 3) &&
              is(world_from_imu, n, 3, 3) && is(velocity, n, 3) && is(cam_from_imu, 3, 3) && is(imu_in_cam, 3),
          "poses: not of one size");
    check(is(in_imu, m, 3) && is(in_cam, m, 3) && is(by_cam, m, 2, 3) && is(by_intrinsics, m, 2, k) && is(line, m) &&
              is(since_middle_s, m) && is(weight, m) && is(by_frame, m, 2, FRAME) && is(by_shared, m, 2, q) &&
              is(by_point, m, 2, 3) && (q == 9 + k || q == 18 + k),
          "derivatives: not of one size");
    check_places(pose, n, "pose: not one of them");
    const Poses poses{since_s.data(), force.data(), rate.data(), reading.data(), vector.data(), turn.data(),
                      world_from_imu.data(), nullptr, velocity.data()};
    const SeenPoints seen{m, pose.data(), in_imu.data(), in_cam.data()};
    const ByCamera by{k, by_cam.data(), by_intrinsics.data(), line.data(), since_middle_s.data(), weight.data(),
                      q != 9 + k};
    nb::gil_scoped_release release;
    apply_chain_rule(poses, {cam_from_imu.data(), imu_in_cam.data()}, seen, by,
                     {by_frame.data(), by_shared.data(), by_point.data()});
}

// Adds the normal equations of a bundle adjustment without its points; see the stub.
bool reduce_points_of(In<int64_t, 1> first, In<int64_t, 1> place, Doubles<3> by_frame,
                      Doubles<3> by_shared, Doubles<3> by_point, Doubles<2> residual, double damping, size_t wide,
                      size_t pitch, In<int64_t, 1> offset, In<int64_t, 1> end, Results<1> values,
                      Results<2> border, Results<2> corner, Results<1> rhs, Results<1> rhs_shared, Results<3> inverse,
                      Results<2> pull, const std::string &instruction_set) {
    const size_t m = place.shape(0), n = rhs.shape(0), q = rhs_shared.shape(0), p = pull.shape(0), f = n / STATE;
    check(is(by_frame, m, 2, FRAME) && is(by_shared, m, 2, q) && is(by_point, m, 2, 3) && is(residual, m, 2),
          "derivatives: not of one size");
    check(is(border, n, q) && is(corner, q, q) && is(inverse, p, 3, 3) && is(first, p + 1) && n == f * STATE,
          "results: not of the size of the derivatives");
    check(first(0) == 0 && size_t(first(p)) == m, "first: not up to the last one");
    int64_t most = 0;
    for (size_t i = 0; i < p; ++i) {
        check(first(i) <= first(i + 1), "first: must not fall");
        most = std::max(most, first(i + 1) - first(i));
    }
    check_places(place, f, "place: not of a frame");
    check(is(offset, f) && is(end, f) && wide >= FRAME && wide <= STATE && pitch >= wide && pitch <= values.shape(0),
          "panels: of another size");
    // the panels' own columns alone have so many rows
    const int64_t places = int64_t(values.shape(0) / (wide * pitch));
    for (size_t i = 0; i < f; ++i) {
        check(end(i) > int64_t(i) && end(i) <= places && (i == 0 || end(i) >= end(i - 1)), "end: not after the place");
        check(offset(i) + int64_t(wide * i * pitch) >= 0 &&
                  offset(i) + int64_t((wide * size_t(end(i)) - 1) * pitch + FRAME) <= int64_t(values.shape(0)),
              "offset: outside the panels");
    }
    const Seen seen{ptrdiff_t(p), ptrdiff_t(q), first.data(), place.data(), by_frame.data(), by_shared.data(),
                    by_point.data(), residual.data(), ptrdiff_t(wide), damping};
    const Reduced out{ptrdiff_t(pitch), values.data(), offset.data(), end.data(), border.data(), corner.data(),
                      rhs.data(), rhs_shared.data(), inverse.data(), pull.data()};
    const PointsSimd &simd = POINTS.require(instruction_set);
    std::vector<double> work(simd.work(seen, most));
    nb::gil_scoped_release release;
    return simd.reduce(seen, out, work.data());
}

}  // namespace

NB_MODULE(_inertial, module) {
    nb::class_<ArrowFactor>(module, "ArrowFactor")
        .def("substitute", &ArrowFactor::substitute, nb::arg("sides").noconvert(), nb::kw_only(),
             nb::arg("half_done") = false)
        .def("selected_inverse", &ArrowFactor::selected_inverse, nb::arg("diagonal").noconvert(),
             nb::arg("right").noconvert());
    module.def("eliminate", &eliminate_chain, nb::rv_policy::take_ownership, nb::arg("diagonal"), nb::arg("below"),
               nb::arg("border"), nb::arg("rhs"), nb::arg("unit"), nb::arg("products").noconvert(), nb::kw_only(),
               nb::arg("forward").noconvert().none() = nb::none(), nb::arg("instruction_set") = "");
    module.def("add_information", &add_information, nb::arg("here"), nb::arg("after").none(),
               nb::arg("by_globals").none(), nb::kw_only(), nb::arg("first"), nb::arg("column"),
               nb::arg("diagonal").noconvert(), nb::arg("below").noconvert(), nb::arg("border").noconvert(),
               nb::arg("corner").noconvert(), nb::arg("instruction_set") = "");
    module.def("preintegrate", &preintegrate_intervals, nb::kw_only(), nb::arg("nodes_s"), nb::arg("steps"),
               nb::arg("gyro_t_s"), nb::arg("gyro"), nb::arg("gyro_slope"), nb::arg("accel_t_s"), nb::arg("accel"),
               nb::arg("accel_slope"), nb::arg("gyro_bias"), nb::arg("accel_bias"), nb::arg("gyro_matrix"),
               nb::arg("accel_matrix"), nb::arg("accel_delay_s"), nb::arg("delay_step_s"),
               nb::arg("rotation").noconvert(), nb::arg("velocity").noconvert(), nb::arg("position").noconvert(),
               nb::arg("cov_gyro").noconvert(), nb::arg("by_gyro_bias").noconvert(),
               nb::arg("by_accel_bias").noconvert(), nb::arg("by_gyro_gain").noconvert(),
               nb::arg("by_accel_gain").noconvert(), nb::arg("by_accel_delay").noconvert(),
               nb::arg("rate").noconvert());
    module.def("whiten_tridiagonal", &whiten_tridiagonal, nb::arg("diagonal"), nb::arg("below"),
               nb::arg("sides").noconvert());
    module.def("place_points", &place_points_of, nb::kw_only(), nb::arg("pose"), nb::arg("point"),
               nb::arg("world_from_imu"), nb::arg("imu_in_world"), nb::arg("points"), nb::arg("cam_from_imu"),
               nb::arg("imu_in_cam"), nb::arg("in_imu").noconvert(), nb::arg("in_cam").noconvert());
    module.def("apply_chain_rule", &apply_chain_rule_of, nb::kw_only(), nb::arg("pose"), nb::arg("since_s"),
               nb::arg("force"), nb::arg("rate"), nb::arg("reading"), nb::arg("vector"), nb::arg("turn"),
               nb::arg("world_from_imu"), nb::arg("velocity"), nb::arg("cam_from_imu"), nb::arg("imu_in_cam"),
               nb::arg("in_imu"), nb::arg("in_cam"), nb::arg("by_cam"), nb::arg("by_intrinsics"), nb::arg("line"),
               nb::arg("since_middle_s"), nb::arg("weight"), nb::arg("by_frame").noconvert(),
               nb::arg("by_shared").noconvert(), nb::arg("by_point").noconvert());
    module.def("reduce_points", &reduce_points_of, nb::kw_only(), nb::arg("first"), nb::arg("place"),
               nb::arg("by_frame"), nb::arg("by_shared"), nb::arg("by_point"), nb::arg("residual"), nb::arg("damping"),
               nb::arg("wide"), nb::arg("pitch"), nb::arg("offset"), nb::arg("end"), nb::arg("values").noconvert(),
               nb::arg("border").noconvert(), nb::arg("corner").noconvert(),
               nb::arg("rhs").noconvert(), nb::arg("rhs_shared").noconvert(), nb::arg("inverse").noconvert(),
               nb::arg("pull").noconvert(), nb::arg("instruction_set") = "");
    module.def("instruction_sets", [] { return SIMD_TABLES.names(); });
}
