// SPDX-License-Identifier: MIT
// Whether values of L are finite and its diagonal is positive, as protocol/factor.py checks them on the host. GPU only.
struct Wrong {      // 0 at first
    int infinite;   // a value is NaN or infinite
    int diagonal;   // a value on the diagonal is not positive
};

template <class Value>
__device__ void check(const Value* values, long long count, const long long* diagonal, int columns, Wrong* wrong) {
    const long long first = blockIdx.x * (long long)blockDim.x + threadIdx.x, step = gridDim.x * (long long)blockDim.x;
    bool infinite = false, below = false;
#pragma unroll 4
    for (long long i = first; i < count; i += step) infinite |= !(values[i] - values[i] == 0);
    for (long long i = first; i < columns; i += step) below |= !(values[diagonal[i]] > 0);
    if (infinite) wrong->infinite = 1;
    if (below) wrong->diagonal = 1;
}

extern "C" __global__ void check_float(const float* values, long long count, const long long* diagonal, int columns, Wrong* wrong) {
    check(values, count, diagonal, columns, wrong);
}
extern "C" __global__ void check_double(const double* values, long long count, const long long* diagonal, int columns, Wrong* wrong) {
    check(values, count, diagonal, columns, wrong);
}
