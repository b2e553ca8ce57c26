// SPDX-License-Identifier: MIT
// The energy of each body after a step, and whether it has run away (kernels/balance.cuh): a thread block for each body, which sums
// over its nodes in a fixed order, decides, and freezes. It runs beside the kernels that assemble the next step, or after the last
// step of a batch; a step that is settled already is left alone.
#include "energy.cuh"

constexpr int STILL = 5, MOST_THREADS = 1024;

struct Account {
    const int* first;        // (bodies + 1,) node of each body
    const real* mass;        // (n,) [kg]
    const real* before;      // (n, 3) x when the step began [m]
    real* x;                 // (n, 3) [m]
    const real* v;           // (n, 3) [m/s]
    real* still[STILL];      // (n, 3) each, or null: v and what else is 0 in a body at rest
    real* force;             // (n, 3) of hands (effects/touch.cu); null: nothing can be touched
    real* spring;            // (n,)
    real* anchor;            // (n, 3)
    real* free;              // (n,) 0 from when a body is frozen
    const real* gravity;     // (3,) [m/s2]
    Balance* balance;        // (bodies,)
    Energy* told;            // (capacity, bodies) on the host
    const long long* step;   // (1,) completed
    long long* settled;      // (bodies,) step that was settled last
    int* frozen;             // (bodies,) out: 1 from when it is frozen
    int bodies, capacity, on_runaway, inertia;
};

#ifdef ACCOUNT_BYTES  // as energies.py has them
static_assert(sizeof(Account) == ACCOUNT_BYTES && sizeof(Balance) == BALANCE_BYTES, "layouts of Account or Balance differ");
static_assert(sizeof(Energy) == ENERGY_BYTES, "layouts of Energy differ");
#endif

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

__device__ __forceinline__ void add_one(const Account& a, int i, Sums& s) {
    const real *x = a.x + 3ll * i, *from = a.before + 3ll * i;
    const double step[3] = {(double)x[0] - from[0], (double)x[1] - from[1], (double)x[2] - from[2]};
    add_node(s, a.mass[i], x, a.v + 3ll * i, step, a.gravity);
    if (!a.force) return;
    real *force = a.force + 3ll * i, *anchor = a.anchor + 3ll * i, &spring = a.spring[i];
    if (spring == 0 && force[0] == 0 && force[1] == 0 && force[2] == 0) return;
    s.work += work_on(force, spring, anchor, from, step);
    force[0] = force[1] = force[2] = spring = 0;  // until something touches the node again
}

// Those of the lane across.
__device__ __forceinline__ Sums sums_across(const Sums& s, int by) {
    Sums o;
    o.kinetic = __shfl_xor_sync(EVERYBODY, s.kinetic, by);
    o.gravity = __shfl_xor_sync(EVERYBODY, s.gravity, by);
    o.fallen = __shfl_xor_sync(EVERYBODY, s.fallen, by);
    o.work = __shfl_xor_sync(EVERYBODY, s.work, by);
    for (int c = 0; c < 3; ++c) {
        o.low[c] = __shfl_xor_sync(EVERYBODY, s.low[c], by);
        o.high[c] = __shfl_xor_sync(EVERYBODY, s.high[c], by);
    }
    return o;
}

__device__ void tell(const Account& a, const Balance& b, int body, long long done) {
    Energy& e = a.told[done % a.capacity * a.bodies + body];
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
__device__ void freeze(const Account& a, int body) {
    for (int i = a.first[body] + threadIdx.x; i < a.first[body + 1]; i += blockDim.x) {
        a.free[i] = 0;
        for (long long k = 3ll * i; k < 3ll * i + 3; ++k) {
            a.x[k] = a.before[k];
            for (real* array : a.still)
                if (array) array[k] = 0;
        }
    }
}

extern "C" __global__ void __launch_bounds__(MOST_THREADS) account(const Account a) {
    __shared__ Sums warps[MOST_THREADS / 32];
    __shared__ int away;
    const int body = blockIdx.x;
    const long long step = a.step[0];
    if (a.settled[body] == step) return;
    Sums s = no_sums();
    for (int i = a.first[body] + threadIdx.x; i < a.first[body + 1]; i += blockDim.x) add_one(a, i, s);
    for (int by = 16; by; by /= 2) add_sums(s, sums_across(s, by));
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = s;
    __syncthreads();
    if (threadIdx.x == 0) {
        for (int k = 1; k < (int)blockDim.x / 32; ++k) add_sums(s, warps[k]);
        Balance b = a.balance[body];
        away = take_stock(b, s, a.on_runaway, a.inertia);
        a.balance[body] = b;
        tell(a, b, body, step - 1);
        a.settled[body] = step;
    }
    __syncthreads();
    if (!away) return;
    if (threadIdx.x == 0) a.frozen[body] = 1;
    freeze(a, body);
}
