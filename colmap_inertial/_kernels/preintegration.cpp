#include "preintegration.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace {

// Reads a track by cubic Hermite polynomials; instants that ask in order cost nothing to find.
class Reader {
   public:
    explicit Reader(const Track &track) : track_(track) {}

    void at(double t, double value[3]) {
        const double *stamp = track_.t;
        const size_t last = track_.samples - 1;
        t = std::min(std::max(t, stamp[0]), stamp[last]);
        while (i_ + 1 < last && stamp[i_ + 1] <= t) ++i_;
        while (i_ > 0 && stamp[i_] > t) --i_;
        const double step = stamp[i_ + 1] - stamp[i_], x = (t - stamp[i_]) / step;
        const double *y = track_.value + 3 * i_, *m = track_.slope + 3 * i_;
        for (int a = 0; a < 3; ++a) {
            const double rise = y[3 + a] - y[a], m0 = step * m[a], m1 = step * m[3 + a];
            const double c2 = 3 * rise - 2 * m0 - m1, c3 = m0 + m1 - 2 * rise;
            value[a] = y[a] + x * (m0 + x * (c2 + x * c3));
        }
    }

   private:
    Track track_;
    size_t i_ = 0;
};

void cross(const double a[3], const double b[3], double out[3]) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

// out = matrix v, row by row
void times(const double *matrix, const double v[3], double out[3]) {
    for (int i = 0; i < 3; ++i) out[i] = matrix[3 * i] * v[0] + matrix[3 * i + 1] * v[1] + matrix[3 * i + 2] * v[2];
}

// q *= exp(turn), xyzw
void turn_by(const double turn[3], double q[4]) {
    const double squared = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2], angle = std::sqrt(squared);
    const double s = angle < 1e-4 ? 0.5 - squared / 48 : std::sin(0.5 * angle) / angle;
    const double x = s * turn[0], y = s * turn[1], z = s * turn[2], w = std::cos(0.5 * angle);
    const double ax = q[0], ay = q[1], az = q[2], aw = q[3];
    q[0] = aw * x + w * ax + ay * z - az * y;
    q[1] = aw * y + w * ay + az * x - ax * z;
    q[2] = aw * z + w * az + ax * y - ay * x;
    q[3] = aw * w - ax * x - ay * y - az * z;
}

void matrix_of(const double q[4], double r[9]) {
    const double x = q[0], y = q[1], z = q[2], w = q[3];
    r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - z * w), r[2] = 2 * (x * z + y * w);
    r[3] = 2 * (x * y + z * w), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - x * w);
    r[6] = 2 * (x * z - y * w), r[7] = 2 * (y * z + x * w), r[8] = 1 - 2 * (x * x + y * y);
}

// out -= [v]x r, for 3 x 3 matrices
void subtract_cross(const double v[3], const double r[9], double out[9]) {
    for (int j = 0; j < 3; ++j) {
        out[j] -= v[1] * r[6 + j] - v[2] * r[3 + j];
        out[3 + j] -= v[2] * r[j] - v[0] * r[6 + j];
        out[6 + j] -= v[0] * r[3 + j] - v[1] * r[j];
    }
}

// An instant within an interval: readings, and the increments from the interval's start.
struct Point {
    double rate[3], reading[3], accel[3], slope[3], force[3];
    double rotation[9], velocity[3], position[3];
};

// Integrals over an interval, with G = [I, -[V]x, -[P]x] of velocity V and position P still to come.
struct Moments {
    double v[3], p[3], vv[9], pv[9], pp[9];  // of V, P, V V', P V', P P'
    double gyro[4][28];                      // of (reading, 1) times G R, row by row
    double accel[4][18];                     // of (reading, 1) times (R, R left)
    double delay[6];                         // of R slope (1, left)

    void add(const Point &point, const Point &end, double left, double weight) {
        double velocity[3], position[3], lever[28] = {}, arm[18], change[3];
        for (int i = 0; i < 3; ++i) {
            velocity[i] = end.velocity[i] - point.velocity[i];
            position[i] = end.position[i] - point.position[i] - left * point.velocity[i];
        }
        for (int i = 0; i < 3; ++i) {
            v[i] += weight * velocity[i];
            p[i] += weight * position[i];
            for (int j = 0; j < 3; ++j) {
                vv[3 * i + j] += weight * velocity[i] * velocity[j];
                pv[3 * i + j] += weight * position[i] * velocity[j];
                pp[3 * i + j] += weight * position[i] * position[j];
            }
        }
        for (int i = 0; i < 9; ++i) lever[i] = arm[i] = point.rotation[i];
        subtract_cross(velocity, point.rotation, lever + 9);
        subtract_cross(position, point.rotation, lever + 18);
        for (int i = 0; i < 9; ++i) arm[9 + i] = left * point.rotation[i];
        for (int r = 0; r < 4; ++r) {
            const double by_gyro = r < 3 ? weight * point.reading[r] : weight;
            const double by_accel = r < 3 ? weight * point.accel[r] : weight;
            for (int i = 0; i < 28; ++i) gyro[r][i] += by_gyro * lever[i];
            for (int i = 0; i < 18; ++i) accel[r][i] += by_accel * arm[i];
        }
        times(point.rotation, point.slope, change);
        for (int i = 0; i < 3; ++i) {
            delay[i] += weight * change[i];
            delay[3 + i] += weight * left * change[i];
        }
    }

    void write_cov_gyro(double dt, double cov[81]) const {
        const auto entry = [cov](int row, int column) -> double & { return cov[9 * row + column]; };
        std::memset(cov, 0, 81 * sizeof(double));
        const double *first[] = {v, p}, *second[] = {vv, pv, pp};
        for (int i = 0; i < 3; ++i) entry(i, i) = dt;
        for (int block = 0; block < 2; ++block) {
            const double *a = first[block];
            const double skew[9] = {0, -a[2], a[1], a[2], 0, -a[0], -a[1], a[0], 0};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    entry(3 + 3 * block + i, j) = entry(j, 3 + 3 * block + i) = -skew[3 * i + j];
        }
        for (int block = 0; block < 3; ++block) {
            const int row = block == 0 ? 3 : 6, column = block == 2 ? 6 : 3;
            const double *a = second[block], trace = a[0] + a[4] + a[8];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    entry(row + i, column + j) = entry(column + j, row + i) = (i == j ? trace : 0) - a[3 * j + i];
        }
    }
};

}  // namespace

void preintegrate(const Track &gyro, const Track &accel, const Intervals &intervals, const Increments &out) {
    Reader gyro_at(gyro), accel_at(accel), later_at(accel), earlier_at(accel);
    std::vector<Point> points;
    for (size_t k = 0; k < intervals.count; ++k) {
        const size_t steps = size_t(intervals.steps[k]);
        const double begin = intervals.nodes[k], dt = intervals.nodes[k + 1] - begin, h = dt / double(steps);
        const double *gyro_bias = intervals.gyro_bias + 3 * k, *accel_bias = intervals.accel_bias + 3 * k;
        points.resize(steps + 1);
        double q[4] = {0, 0, 0, 1};
        for (size_t s = 0; s <= steps; ++s) {
            Point &here = points[s];
            const double t = begin + double(s) * h, accel_t = t - intervals.accel_delay;
            double later[3], earlier[3], force[3];
            gyro_at.at(t, here.reading);
            accel_at.at(accel_t, here.accel);
            later_at.at(accel_t + intervals.delay_step, later);
            earlier_at.at(accel_t - intervals.delay_step, earlier);
            times(intervals.gyro_matrix, here.reading, here.rate);
            times(intervals.accel_matrix, here.accel, force);
            for (int i = 0; i < 3; ++i) {
                here.rate[i] -= gyro_bias[i];
                force[i] -= accel_bias[i];
                here.slope[i] = (later[i] - earlier[i]) / (2 * intervals.delay_step);
            }
            if (s > 0) {
                // Second-order Magnus expansion for a rate that changes linearly within the step
                double turn[3];
                cross(points[s - 1].rate, here.rate, turn);
                for (int i = 0; i < 3; ++i)
                    turn[i] = 0.5 * h * (points[s - 1].rate[i] + here.rate[i]) + h * h / 12 * turn[i];
                turn_by(turn, q);
            }
            matrix_of(q, here.rotation);
            times(here.rotation, force, here.force);
            for (int i = 0; i < 3; ++i) {
                if (s == 0) {
                    here.velocity[i] = here.position[i] = 0;
                    continue;
                }
                const Point &before = points[s - 1];
                here.velocity[i] = before.velocity[i] + 0.5 * h * (before.force[i] + here.force[i]);
                here.position[i] = before.position[i] + h * before.velocity[i] +
                                   h * h / 6 * (2 * before.force[i] + here.force[i]);
            }
        }
        const Point &end = points[steps];
        Moments moments{};
        for (size_t s = 0; s <= steps; ++s)
            moments.add(points[s], end, dt - double(s) * h, s == 0 || s == steps ? 0.5 * h : h);

        std::copy(end.rotation, end.rotation + 9, out.rotation + 9 * k);
        std::copy(end.velocity, end.velocity + 3, out.velocity + 3 * k);
        std::copy(end.position, end.position + 3, out.position + 3 * k);
        std::copy(points[0].rate, points[0].rate + 3, out.rate + 3 * k);
        if (k + 1 == intervals.count) std::copy(end.rate, end.rate + 3, out.rate + 3 * k + 3);
        moments.write_cov_gyro(dt, out.cov_gyro + 81 * k);
        double *gyro_bias_out = out.by_gyro_bias + 27 * k, *accel_bias_out = out.by_accel_bias + 27 * k;
        double *gyro_gain_out = out.by_gyro_gain + 81 * k, *accel_gain_out = out.by_accel_gain + 81 * k;
        for (int i = 0; i < 27; ++i) {
            const bool moved = i >= 9;  // the accelerometer does not turn anything
            gyro_bias_out[i] = -moments.gyro[3][i];
            accel_bias_out[i] = moved ? -moments.accel[3][i - 9] : 0;
            for (int r = 0; r < 3; ++r) {
                gyro_gain_out[3 * i + r] = moments.gyro[r][i];
                accel_gain_out[3 * i + r] = moved ? moments.accel[r][i - 9] : 0;
            }
        }
        double *delay_out = out.by_accel_delay + 9 * k;
        for (int i = 0; i < 9; ++i) delay_out[i] = i < 3 ? 0 : -moments.delay[i - 3];
    }
}
