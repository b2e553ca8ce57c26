// SPDX-License-Identifier: MIT
// Boxes along the axes of the world; shared by both devices.
#pragma once
#include "host_device.cuh"
#ifndef __CUDACC_RTC__
#include <cmath>
#endif

struct Box {
    double low[3], high[3];
};

constexpr double NOWHERE = 1e300;  // beyond any place

// A box with nothing in it.
HOST_DEVICE Box empty_box() { return {{NOWHERE, NOWHERE, NOWHERE}, {-NOWHERE, -NOWHERE, -NOWHERE}}; }

HOST_DEVICE void include(Box& box, const double* x, double margin) {
    for (int k = 0; k < 3; ++k) {
        box.low[k] = fmin(box.low[k], x[k] - margin);
        box.high[k] = fmax(box.high[k], x[k] + margin);
    }
}
HOST_DEVICE Box joined(const Box& a, const Box& b) {
    Box box = a;
    include(box, b.low, 0);
    include(box, b.high, 0);
    return box;
}
HOST_DEVICE bool meet(const Box& a, const Box& b) {
    for (int k = 0; k < 3; ++k)
        if (!(a.low[k] <= b.high[k] && b.low[k] <= a.high[k])) return false;
    return true;
}
