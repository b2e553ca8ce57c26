// SPDX-License-Identifier: MIT
// The energy of each body after a step, and whether it has run away (kernels/balance.cuh), in the last kernel of a step: each warp
// leaves the sums over its nodes, those of different bodies apart, and the thread block that comes last adds them up in a fixed
// order, decides, and freezes.
#pragma once
#include "balance.cuh"

struct Motion { real *x, *v, *before, *dv, *ahead, *drift, *carried; };  // (n, 3) of the kernel's items, or null

struct __align__(16) Partial { double kinetic, gravity, fallen, work; float low[3], high[3]; };

struct Energy {              // goes home beside Result
    double kinetic, elastic, gravity, work, budget, stride;
    int phase, found;
};

struct Account {
    const int* body;         // (n,) of each node
    const int* first;        // (bodies + 1,) node of each body
    const real* mass;        // (n,) [kg]
    real* force;             // (n, 3) of hands (effects/touch.cu); null: nothing can be touched
    real* spring;            // (n,)
    real* anchor;            // (n, 3)
    real* free;              // (n,) 0 from when a body is frozen
    Partial* partial;        // (n / 32 + bodies + 1,) of warp w and body b at w + b: both grow with the node
    Balance* balance;        // (bodies,)
    Energy* told;            // (capacity, bodies) on the host
    const real* gravity;     // (3,) [m/s2]
    int bodies, on_runaway, inertia;
    int lanes;               // threads that share the sums of a body: a power of two, at most those of a thread block
};

#define EVERYBODY 0xffffffffu

__device__ __forceinline__ void add_sums(Sums& a, const Sums& b) {
    a.kinetic += b.kinetic;
    a.gravity += b.gravity;
    a.fallen += b.fallen;
    a.work += b.work;
    for (int c = 0; c < 3; ++c) {
        a.low[c] = b.low[c] < a.low[c] ? b.low[c] : a.low[c];
        a.high[c] = b.high[c] > a.high[c] ? b.high[c] : a.high[c];
    }
}

// Those of the thread `by` lanes before, or of the one across.
template <bool ACROSS> __device__ __forceinline__ Sums sums_from(const Sums& s, int by) {
    Sums o;
    auto from = [&](auto a) {
        if constexpr (ACROSS) return __shfl_xor_sync(EVERYBODY, a, by);
        else return __shfl_up_sync(EVERYBODY, a, by);
    };
    o.kinetic = from(s.kinetic);
    o.gravity = from(s.gravity);
    o.fallen = from(s.fallen);
    o.work = from(s.work);
    for (int c = 0; c < 3; ++c) {
        o.low[c] = from((float)s.low[c]);
        o.high[c] = from((float)s.high[c]);
    }
    return o;
}

// Sums of this thread's node, and from them those of the warp's bodies.
__device__ void leave_sums(const Account& a, const Motion& m, int i, int n) {
    const bool mine = i < n;
    const int body = mine ? a.body[i] : -1, lane = threadIdx.x & 31;
    Sums s = no_sums();
    if (mine) {
        const real *x = m.x + 3ll * i, *v = m.v + 3ll * i, *from = m.before + 3ll * i;
        const double step[3] = {(double)x[0] - from[0], (double)x[1] - from[1], (double)x[2] - from[2]};
        add_node(s, a.mass[i], x, v, step, a.gravity);
        if (a.force) {
            real *force = a.force + 3ll * i, *anchor = a.anchor + 3ll * i, &spring = a.spring[i];
            if (spring != 0 || force[0] != 0 || force[1] != 0 || force[2] != 0) {
                s.work = work_on(force, spring, anchor, from, step);
                force[0] = force[1] = force[2] = spring = 0;  // until something touches the node again
            }
        }
    }
    for (int by = 1; by < 32; by *= 2) {
        const Sums o = sums_from<false>(s, by);
        const int whose = __shfl_up_sync(EVERYBODY, body, by);
        if (lane >= by && whose == body) add_sums(s, o);
    }
    const int next = __shfl_down_sync(EVERYBODY, body, 1);
    if (!mine || (lane < 31 && next == body)) return;
    Partial& p = a.partial[i / 32 + body];
    p.kinetic = s.kinetic;
    p.gravity = s.gravity;
    p.fallen = s.fallen;
    p.work = s.work;
    for (int c = 0; c < 3; ++c) {
        p.low[c] = s.low[c];
        p.high[c] = s.high[c];
    }
}

__device__ __forceinline__ Sums partial_at(const Account& a, int k) {
    const Partial& p = a.partial[k];
    Sums s = no_sums();
    s.kinetic = __ldcg(&p.kinetic);
    s.gravity = __ldcg(&p.gravity);
    s.fallen = __ldcg(&p.fallen);
    s.work = __ldcg(&p.work);
    for (int c = 0; c < 3; ++c) {
        s.low[c] = __ldcg(&p.low[c]);
        s.high[c] = __ldcg(&p.high[c]);
    }
    return s;
}

// Over a body's partial sums, by `lanes` neighbouring threads, the first of which has the result. All threads come here.
__device__ __forceinline__ Sums sums_of_body(const Account& a, int body) {
    __shared__ Sums warps[32];
    const int lanes = a.lanes, mine = threadIdx.x % lanes, warp = threadIdx.x / 32;
    Sums s = no_sums();
    if (body < a.bodies)
        for (int k = a.first[body] / 32 + body + mine, end = (a.first[body + 1] - 1) / 32 + body; k <= end; k += lanes)
            add_sums(s, partial_at(a, k));
    for (int by = (lanes < 32 ? lanes : 32) / 2; by; by /= 2) add_sums(s, sums_from<true>(s, by));
    if (lanes <= 32) return s;
    __syncthreads();  // what was there before has been read
    if (threadIdx.x % 32 == 0) warps[warp] = s;
    __syncthreads();
    if (mine == 0)
        for (int k = 1; k < lanes / 32; ++k) add_sums(s, warps[warp + k]);
    return s;
}

__device__ void tell(const Account& a, const Balance& b, int body, long long slot) {
    Energy& e = a.told[slot * a.bodies + body];
    e.kinetic = b.kinetic;
    e.elastic = __longlong_as_double(0x7ff8000000000000ll);  // not evaluated
    e.gravity = b.gravity;
    e.work = b.work;
    e.budget = b.budget;
    e.stride = b.stride;
    e.phase = b.phase;
    e.found = b.found;
}

// Back to where the step began, and at rest from now on: as if all nodes were fixed.
__device__ void freeze(const Account& a, const Motion& m, int body) {
    real* const still[] = {m.v, m.dv, m.ahead, m.drift, m.carried};
    for (int i = a.first[body] + threadIdx.x; i < a.first[body + 1]; i += blockDim.x) {
        a.free[i] = 0;
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
            m.x[k] = __ldcg(m.before + k);
            for (real* array : still)
                if (array) array[k] = 0;
        }
    }
}

// By all threads of the thread block that comes last.
__device__ void settle_account(const Account& a, const Motion& m, long long slot) {
    __shared__ int away;
    if (threadIdx.x == 0) away = 0;
    __syncthreads();
    for (int first = 0; first < a.bodies; first += blockDim.x / a.lanes) {
        const int body = first + threadIdx.x / a.lanes;
        const Sums s = sums_of_body(a, body);
        if (body >= a.bodies || threadIdx.x % a.lanes) continue;
        Balance b = a.balance[body];
        if (take_stock(b, s, a.on_runaway, a.inertia)) away = 1;
        a.balance[body] = b;
        tell(a, b, body, slot);
    }
    __syncthreads();
    if (!away) return;
    for (int body = 0; body < a.bodies; ++body)
        if (a.balance[body].found && a.balance[body].phase == FROZEN) freeze(a, m, body);
}
