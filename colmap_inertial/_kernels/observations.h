// Observations of a bundle adjustment: points in the camera, and the chain rule from the camera's derivatives on.
#pragma once

#include <cstddef>
#include <cstdint>

// Poses of the IMU at N instants: of each frame, or of each observation's line.
struct Poses {
    const double *since;           // (N,) seconds after the frame's node
    const double *force;           // (N, 3) at the node, body frame
    const double *rate;            // (N, 3) body frame
    const double *reading;         // (N, 3) rotation vector since the node, by the readings
    const double *vector;          // (N, 3) the same less their errors
    const double *turn;            // (N, 3, 3) and as a matrix
    const double *world_from_imu;  // (N, 3, 3)
    const double *position;        // (N, 3)
    const double *velocity;        // (N, 3)
};

struct Mounting {
    const double *cam_from_imu;  // (3, 3)
    const double *imu_in_cam;    // (3,)
};

struct SeenPoints {
    size_t count;          // M
    const int64_t *pose;   // (M,)
    const double *in_imu;  // (M, 3)
    const double *in_cam;  // (M, 3)
};

struct ByCamera {
    size_t intrinsics;            // k
    const double *by_cam;         // (M, 2, 3)
    const double *by_intrinsics;  // (M, 2, k)
    const double *line;           // (M,) in readouts
    const double *since_middle;   // (M,) seconds, for the clock rate
    const double *weight;         // (M,)
    bool rolling;                 // whether the gyroscope's gains count
};

struct ByNumbers {
    double *by_frame;   // (M, 2, 9)
    double *by_shared;  // (M, 2, 9 + k), with gains nine more
    double *by_point;   // (M, 2, 3)
};

// in_imu and in_cam (M, 3) of points (P, 3).
void place_points(const Poses &poses, const Mounting &mounting, size_t count, const int64_t *pose,
                  const int64_t *point, const double *points, double *in_imu, double *in_cam);

// Weighted derivatives by states, shared numbers and points.
void apply_chain_rule(const Poses &poses, const Mounting &mounting, const SeenPoints &seen, const ByCamera &by,
                      const ByNumbers &out);
