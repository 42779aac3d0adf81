#include "observations.h"

namespace {

// out = v' A, and out = A v, of a matrix (3, 3)
void from_left(const double *v, const double *a, double *out) {
    for (int j = 0; j < 3; ++j) out[j] = v[0] * a[j] + v[1] * a[3 + j] + v[2] * a[6 + j];
}

void from_right(const double *a, const double *v, double *out) {
    for (int i = 0; i < 3; ++i) out[i] = a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

// a x b, which is also the row a' [b]x
void cross(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

}  // namespace

void place_points(const Poses &poses, const Mounting &mounting, size_t count, const int64_t *pose,
                  const int64_t *point, const double *points, double *in_imu, double *in_cam) {
    for (size_t o = 0; o < count; ++o, in_imu += 3, in_cam += 3) {
        const double *x = points + 3 * point[o], *p = poses.position + 3 * pose[o];
        const double away[3] = {x[0] - p[0], x[1] - p[1], x[2] - p[2]};
        from_left(away, poses.world_from_imu + 9 * pose[o], in_imu);
        from_right(mounting.cam_from_imu, in_imu, in_cam);
        for (int i = 0; i < 3; ++i) in_cam[i] += mounting.imu_in_cam[i];
    }
}

void apply_chain_rule(const Poses &poses, const Mounting &mounting, const SeenPoints &seen, const ByCamera &by,
                      const ByNumbers &out) {
    const size_t k = by.intrinsics, shared = 9 + k + (by.rolling ? 9 : 0);
    for (size_t o = 0; o < seen.count; ++o) {
        const int64_t at = seen.pose[o];
        const double *in_imu = seen.in_imu + 3 * o, *in_cam = seen.in_cam + 3 * o;
        const double *turn = poses.turn + 9 * at, *world_from_imu = poses.world_from_imu + 9 * at;
        const double *vector = poses.vector + 3 * at, *reading = poses.reading + 3 * at;
        const double since = poses.since[at], weight = by.weight[o];
        double arm[3], before[3], moving[3], passed[3];
        // X_imu = turn' Exp(-theta) R' (X - p): what theta turns, and the force that it turns along
        from_right(turn, in_imu, before);
        for (int i = 0; i < 3; ++i) before[i] += 0.5 * since * since * poses.force[3 * at + i];
        for (int i = 0; i < 3; ++i) arm[i] = in_cam[i] - mounting.imu_in_cam[i];
        cross(in_imu, poses.rate + 3 * at, moving);
        from_left(poses.velocity + 3 * at, world_from_imu, passed);
        for (int i = 0; i < 3; ++i) moving[i] -= passed[i];
        for (size_t row = 2 * o; row < 2 * o + 2; ++row) {
            double *by_frame = out.by_frame + 9 * row, *by_point = out.by_point + 3 * row;
            double *by_shared = out.by_shared + shared * row;
            double by_cam[3], by_imu[3], turned[3];
            for (int i = 0; i < 3; ++i) by_cam[i] = weight * by.by_cam[3 * row + i];
            from_left(by_cam, mounting.cam_from_imu, by_imu);
            from_right(world_from_imu, by_imu, by_point);
            from_right(turn, by_imu, turned);
            cross(turned, before, by_frame);
            for (int i = 0; i < 3; ++i) {
                by_frame[3 + i] = -by_point[i];
                by_frame[6 + i] = -since * by_point[i];
            }
            const double by_time = dot(by_imu, moving);
            cross(arm, by_cam, by_shared);
            for (int i = 0; i < 3; ++i) by_shared[3 + i] = by_cam[i];
            by_shared[6] = -by_time;
            by_shared[7] = -by.since_middle[o] * by_time;
            by_shared[8] = by.line[o] * by_time;
            for (size_t i = 0; i < k; ++i) by_shared[9 + i] = weight * by.by_intrinsics[k * row + i];
            if (!by.rolling) continue;
            // the derivative of a rotation vector to the second order of an angle of a few degrees
            double by_vector[3], once[3], twice[3];
            cross(by_imu, in_imu, by_vector);
            cross(by_vector, vector, once);
            cross(once, vector, twice);
            for (int i = 0; i < 3; ++i) by_vector[i] += twice[i] / 6 - 0.5 * once[i];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) by_shared[9 + k + size_t(3 * i + j)] = by_vector[i] * reading[j];
        }
    }
}
