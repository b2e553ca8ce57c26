// SPDX-License-Identifier: MIT
// The end of a step: one more is completed, the barriers of the next solve begin at zero, and the device's clock is noted.
// stamps (capacity, 2): ns when each step began and ended; a step begins when the one before has ended, the first of a batch
// when the batch does.
__device__ long long nanoseconds() {
    long long t;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(t));
    return t;
}

extern "C" __global__ void tick(double* clock, long long* step, double dt, unsigned* arrived, int barriers, long long* stamps,
                                int capacity) {
    for (int k = threadIdx.x; k < barriers; k += blockDim.x) arrived[k] = 0;
    if (threadIdx.x == 0) {
        long long done = step[0], t = nanoseconds();
        stamps[2 * (done % capacity) + 1] = t;
        stamps[2 * ((done + 1) % capacity)] = t;
        step[0] = done + 1;
        clock[0] = (done + 1) * dt;
    }
}

extern "C" __global__ void stamp(const long long* step, long long* stamps, int capacity) {
    stamps[2 * (step[0] % capacity)] = nanoseconds();
}
