// SPDX-License-Identifier: MIT
// Poses of obstacles and holders in a step (sim_server/effects/_movable.py).
#include "kernel.h"
#include "shapes.cuh"

// What decides about the pose.
enum Motion { FIXED = 0, KEYFRAMES = 1, CLIENT = 2 };

struct Place {
    int n;                 // rigid frames
    const double* clock;   // (1,) t at the start of the step [s]
    double dt;             // time step [s]
    const int* motion;     // (n,) Motion
    const int* first;      // (n + 1,) into the keyframes
    const double* time;    // (first[n],) of each keyframe, ascending [s]
    const double* frame;   // (first[n], 7) its pose
    const double* target;  // (n, 7) poses that clients want
    const double* speed;   // (n,) greatest speed towards them [m/s]
    const double* turn;    // (n,) greatest angular velocity [rad/s]
    const double* ball;    // (n, 4) centre and radius of a sphere around the shape, in its frame; radius < 0: it has no end
    double* placed;        // (n,) t for which begin and end are; negative at first [s]
    double* begin;         // (n, 7) out: pose at t
    double* end;           // (n, 7) in, out: pose at t + dt
    double* swept;         // (n, 4) out: centre and radius of a sphere around the ball at both poses; radius < 0: it has no end
};

// Turns from the rotation of pose a to that of b, by part s of the angle between them and at most `most` [rad]. Returns the angle.
INLINE double turn_between(const double* a, const double* b, double s, double most, double* out) {
    double w = 0, size = 0, between[4];
    for (int k = 3; k < 7; ++k) w += a[k] * b[k];
    const double sign = w < 0 ? -1 : 1;
    for (int k = 0; k < 4; ++k) {  // the part of b that is not along a
        between[k] = sign * b[3 + k] - sign * w * a[3 + k];
        size += between[k] * between[k];
    }
    size = sqrt(size);
    const double half = atan2(size, sign * w);
    const double angle = 2 * s * half < most ? s * half : most / 2;
    const double along = cos(angle), aside = size > 0 ? sin(angle) / size : 0;
    double length = 0;
    for (int k = 0; k < 4; ++k) {
        out[3 + k] = along * a[3 + k] + aside * between[k];
        length += out[3 + k] * out[3 + k];
    }
    length = sqrt(length);
    for (int k = 3; k < 7; ++k) out[k] /= length;
    return 2 * half;
}

// Pose between the keyframes [first, last) at time t: straight, and by the shortest rotation at constant angular velocity.
INLINE void pose_at(const Place& p, int first, int last, double t, double* out) {
    int next = first;
    while (next < last && p.time[next] <= t) ++next;
    const double *b = p.frame + 7 * (next < last ? next : last - 1), *a = next > first ? b - (next < last ? 7 : 0) : b;
    const double s = a == b ? 0 : (t - p.time[next - 1]) / (p.time[next] - p.time[next - 1]);
    for (int k = 0; k < 3; ++k) out[k] = a[k] + s * (b[k] - a[k]);
    turn_between(a, b, s, 10, out);
}

// Goes from a pose towards a target, at most `far` [m] and `most` [rad].
INLINE void approach(const double* from, const double* target, double far, double most, double* out) {
    double way[3];
    for (int k = 0; k < 3; ++k) way[k] = target[k] - from[k];
    const double length = sqrt(dot3(way, way)), part = length > far ? far / length : 1;
    for (int k = 0; k < 3; ++k) out[k] = part == 1 ? target[k] : from[k] + part * way[k];
    if (turn_between(from, target, 1, most, out) <= most)
        for (int k = 3; k < 7; ++k) out[k] = target[k];
}

// A second call for the same t leaves `begin` as it is.
MAILED_KERNEL(place, Place) {
    const double t = p.clock[0];
    double *begin = p.begin + 7 * i, *end = p.end + 7 * i;
    if (p.placed[i] != t)
        for (int k = 0; k < 7; ++k) begin[k] = end[k];
    p.placed[i] = t;
    if (p.motion[i] == KEYFRAMES) {
        pose_at(p, p.first[i], p.first[i + 1], t, begin);
        pose_at(p, p.first[i], p.first[i + 1], t + p.dt, end);
    } else if (p.motion[i] == CLIENT) {
        approach(begin, p.target + 7 * i, p.speed[i] * p.dt, p.turn[i] * p.dt, end);
    }
    double before[3], after[3], way[3];
    world_point(begin, p.ball + 4 * i, before);
    world_point(end, p.ball + 4 * i, after);
    for (int k = 0; k < 3; ++k) {
        way[k] = after[k] - before[k];
        p.swept[4 * i + k] = before[k] + way[k] / 2;
    }
    const double radius = p.ball[4 * i + 3];
    p.swept[4 * i + 3] = radius < 0 ? -1 : radius + sqrt(dot3(way, way)) / 2;
}
