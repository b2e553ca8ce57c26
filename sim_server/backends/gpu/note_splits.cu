// SPDX-License-Identifier: MIT
// Notes when bodies were split: the solver (pcg.cu) uses no factor of a matrix from before, which has another pattern.

struct SplitNotes {
    int bodies;
    const long long* number;  // (bodies,) of the pattern that the body has now
    long long* noted;         // (bodies,) in, out: the same as of the last call
    const long long* step;    // (1,) completed steps
    long long* split_step;    // (bodies,) in, out: steps completed when the body got its pattern
};

extern "C" __global__ void note_splits(const SplitNotes p) {
    for (int k = threadIdx.x; k < p.bodies; k += blockDim.x) {
        if (p.number[k] == p.noted[k]) continue;
        p.noted[k] = p.number[k];
        p.split_step[k] = *p.step;
    }
}
