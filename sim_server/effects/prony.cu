// SPDX-License-Identifier: MIT
// Viscous branches of tetrahedra (formulas: prony.py).
#define WIDE
#include "turning_strain.cuh"

struct PronyHistory {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) where the last step ended [m]
    const local* gradients;  // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes and in a frozen body
    const int* watched;      // (n,) a node of the element's body that is free unless the body is frozen
    int terms;
    const local* decay;      // (terms, n) exp(-dt / tau)
    const local* gain;       // (terms, n) (1 - exp(-dt / tau)) tau / dt
    local* reached;          // (6, n) in, out: deviatoric strain at the end of the step before, of this one
    local* overstrain;       // (6 terms, n) in, out: q of the branches
};

// Once a step.
KERNEL(advance, PronyHistory) {
    typedef local_number T;
    index tet[4];
    symmetric6<T> now = deviator(turned_element_at(p, i, tet).strain), before = symmetric_at(p.reached, p.n, i);
    auto live = is_live(p, i);
    for (int t = 0; t < p.terms; ++t) {
        local* branch = p.overstrain + 6 * t * (long long)p.n;
        symmetric6<T> q = symmetric_at(branch, p.n, i);
        T decay = at_items(p.decay + t * (long long)p.n, i), gain = at_items(p.gain + t * (long long)p.n, i);
        UNROLL for (int k = 0; k < 6; ++k) q.m[k] = live ? decay * q.m[k] + gain * (now.m[k] - before.m[k]) : q.m[k];
        put_symmetric(branch, p.n, i, q);
    }
    UNROLL for (int k = 0; k < 6; ++k) now.m[k] = live ? now.m[k] : before.m[k];
    put_symmetric(p.reached, p.n, i, now);
}

struct PronyElements {
    int n;                    // elements
    const int* tets;          // (n, 4) nodes
    const real* x;            // (nodes, 3) positions [m]
    const real* v;            // (nodes, 3) what the tangent is applied to: world.predictor [m/s]
    const local* gradients;   // (9, n) [1/m]
    const local* volume;      // (n,) [m3]
    const local* shear;       // (n,) shear modulus that g is relative to [Pa]
    local h;                  // factor of the force [s]
    local tangent;            // factor of the tangent [s2]
    int terms;
    const local* kept;        // (terms, n) g times what is left of q at the instant of the forces
    const local* share;       // (n,) sum of g gamma
    const local* reached;     // (6, n) deviatoric strain where the step began
    const local* overstrain;  // (6 terms, n) q of the branches there
    local* corners;           // (4, n, 9) out: h f_a - tangent (K v)_a [N s], upper triangle of tangent K_aa [kg]
    local* edges;             // (6, n, 9) out: tangent K_ab, a < b [kg]
};

KERNEL(elements, PronyElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4], D[4];
    TurnedElement<T> e = turned_element_at(p, i, tet);
    field_edges(p.v, tet, v);
    symmetric6<T> stress = deviator(e.strain), before = symmetric_at(p.reached, p.n, i);
    T mu = at_items(p.volume, i) * at_items(p.shear, i), share = at_items(p.share, i);
    UNROLL for (int k = 0; k < 6; ++k) stress.m[k] = share * (stress.m[k] - before.m[k]);
    for (int t = 0; t < p.terms; ++t) {
        T kept = at_items(p.kept + t * (long long)p.n, i);
        symmetric6<T> q = symmetric_at(p.overstrain + 6 * t * (long long)p.n, p.n, i);
        UNROLL for (int k = 0; k < 6; ++k) stress.m[k] += kept * q.m[k];
    }
    UNROLL for (int k = 0; k < 6; ++k) stress.m[k] *= 2 * p.h * mu;
    impulses_of(e, without_torque(e, stress), impulse);
    world_gradients(e, D);
    mu *= p.tangent * share;
    Blocks6<T> B = isotropic_blocks(D, -(local)(2.0 / 3) * mu, mu);
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct PronyEnergy {
    int n;                    // elements
    const int* tets;          // (n, 4)
    const real* x;            // (nodes, 3) [m]
    const local* gradients;   // (9, n) [1/m]
    const local* volume;      // (n,) [m3]
    const local* shear;       // (n,) [Pa]
    int terms;
    const local* weight;      // (terms, n) g
    const local* decay;       // (terms, n)
    const local* gain;        // (terms, n)
    const local* reached;     // (6, n)
    const local* overstrain;  // (6 terms, n)
    local* energy;            // (n,) out: V mu sum of g |q|^2, q at the end of the step [J]
};

KERNEL(energy, PronyEnergy) {
    typedef local_number T;
    index tet[4];
    symmetric6<T> now = deviator(turned_element_at(p, i, tet).strain), before = symmetric_at(p.reached, p.n, i);
    T sum = T{};
    for (int t = 0; t < p.terms; ++t) {
        symmetric6<T> q = symmetric_at(p.overstrain + 6 * t * (long long)p.n, p.n, i);
        T decay = at_items(p.decay + t * (long long)p.n, i), gain = at_items(p.gain + t * (long long)p.n, i);
        UNROLL for (int k = 0; k < 6; ++k) q.m[k] = decay * q.m[k] + gain * (now.m[k] - before.m[k]);
        sum += at_items(p.weight + t * (long long)p.n, i) * contraction(q, q);
    }
    put(p.energy, i, at_items(p.volume, i) * at_items(p.shear, i) * sum);
}
