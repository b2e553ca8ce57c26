// SPDX-License-Identifier: MIT
#pragma once
#include "host_device.cuh"

// v = inverse of the symmetric 3x3 block a, row major; whole = false: of its diagonal alone.
template <class T>
HOST_DEVICE void invert3(const T* a, bool whole, T* v) {
    if (!whole) {
        for (int m = 0; m < 9; ++m) v[m] = 0;
        v[0] = 1 / a[0]; v[4] = 1 / a[4]; v[8] = 1 / a[8];
        return;
    }
    T c0 = a[4] * a[8] - a[5] * a[7], c1 = a[5] * a[6] - a[3] * a[8], c2 = a[3] * a[7] - a[4] * a[6];
    T d = 1 / (a[0] * c0 + a[1] * c1 + a[2] * c2);
    v[0] = d * c0; v[4] = d * (a[0] * a[8] - a[2] * a[6]); v[8] = d * (a[0] * a[4] - a[1] * a[3]);
    v[1] = v[3] = d * c1; v[2] = v[6] = d * c2; v[5] = v[7] = d * (a[1] * a[6] - a[0] * a[7]);
}
