// SPDX-License-Identifier: MIT
// The end of a step: one more is completed, the barriers of the next solve begin at zero, and the results go to the host with
// the device's clock. stamps (capacity, 2): ns when each step began and ended; a step begins when the one before has ended, or
// when `stamp` says so. stamps and reports lie in page-locked host memory, the ring of results on the device.
__device__ long long nanoseconds() {
    long long t;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(t));
    return t;
}

extern "C" __global__ void tick(double* clock, long long* step, double dt, unsigned* arrived, int barriers, int capacity,
                                long long* stamps, const long long* results, long long* reports, int words) {
    const long long done = step[0], slot = done % capacity;
    for (int k = threadIdx.x; k < words; k += blockDim.x) reports[slot * words + k] = results[slot * words + k];
    for (int k = threadIdx.x; k < barriers; k += blockDim.x) arrived[k] = 0;
    __syncthreads();
    if (threadIdx.x == 0) {
        long long t = nanoseconds();
        stamps[2 * slot + 1] = t;
        stamps[2 * ((done + 1) % capacity)] = t;
        step[0] = done + 1;
        clock[0] = (done + 1) * dt;
    }
}

extern "C" __global__ void stamp(const long long* step, long long* stamps, int capacity) {
    stamps[2 * (step[0] % capacity)] = nanoseconds();
}
