// Inertial increments over intervals, as `Preintegrated` in inertial/scale/_preintegration.py has them.
#pragma once

#include <cstddef>
#include <cstdint>

struct Track {
    size_t samples;       // at least 2
    const double *t;      // (N,)
    const double *value;  // (N, 3)
    const double *slope;  // (N, 3)
};

struct Intervals {
    size_t count;                 // K
    const double *nodes;          // (K + 1,)
    const int64_t *steps;         // (K,)
    const double *gyro_bias;      // (K, 3)
    const double *accel_bias;     // (K, 3)
    const double *gyro_matrix;    // (3, 3): I + E
    const double *accel_matrix;   // (3, 3)
    double accel_delay;           // added to the accelerometer's times
    double delay_step;            // half the span of the finite difference by the delay
};

struct Increments {
    double *rotation;        // (K, 3, 3)
    double *velocity;        // (K, 3)
    double *position;        // (K, 3)
    double *cov_gyro;        // (K, 9, 9)
    double *by_gyro_bias;    // (K, 9, 3)
    double *by_accel_bias;   // (K, 9, 3)
    double *by_gyro_gain;    // (K, 9, 9)
    double *by_accel_gain;   // (K, 9, 9)
    double *by_accel_delay;  // (K, 9)
    double *rate;            // (K + 1, 3)
};

void preintegrate(const Track &gyro, const Track &accel, const Intervals &intervals, const Increments &out);
