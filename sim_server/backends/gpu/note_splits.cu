// SPDX-License-Identifier: MIT
// Notes when bodies were split and nodes were copied: by that the solver (pcg.cu) uses factors of matrices from before, which have
// another pattern.

struct SplitNotes {
    int bodies, nodes;
    const long long* number;  // (bodies,) of the pattern that the body has now
    long long* noted;         // (bodies,) in, out: the same as of the last call
    const long long* step;    // (1,) completed steps
    long long* split_step;    // (bodies,) in, out: steps completed when the body got its pattern
    const int* origin;        // (nodes,) node that each was copied from, itself, or -1 (effects/cutting_split.cu)
    int* origin_noted;        // (nodes,) in, out: the same as of the last call
    long long* copied_step;   // (nodes,) in, out: steps completed when the node was copied
    long long* spread_step;   // (nodes,) in, out: likewise when it was copied last, or a copy of it
};

extern "C" __global__ void note_splits(const SplitNotes p) {
    for (int k = threadIdx.x; k < p.bodies; k += blockDim.x) {
        if (p.number[k] == p.noted[k]) continue;
        p.noted[k] = p.number[k];
        p.split_step[k] = *p.step;
    }
    for (int i = threadIdx.x; i < p.nodes; i += blockDim.x) {
        if (p.origin[i] == p.origin_noted[i]) continue;
        p.origin_noted[i] = p.origin[i];
        if (p.origin[i] < 0 || p.origin[i] == i) continue;
        p.copied_step[i] = *p.step;
        for (int j = i; p.origin[j] != j;) {  // all write the same
            j = p.origin[j];
            p.spread_step[j] = *p.step;
        }
    }
}
