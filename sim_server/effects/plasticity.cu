// SPDX-License-Identifier: MIT
// Plastic flow of corotational tetrahedra (formulas: plasticity.py).
#define WIDE
#include "turning_strain.cuh"

// Return to the yield surface from a strain.
template <class T> struct Flow {
    symmetric6<T> direction;  // n, of norm 1
    T amount;                 // of flow, of norm |d plastic|
    T trial, radius;          // norm of the relative stress without flow; of the yield surface [Pa]
};

// constants (3, n): yield stress, isotropic and kinematic hardening [Pa].
template <class T>
INLINE Flow<T> flow_to(const symmetric6<T>& deviatoric, const symmetric6<T>& plastic, T hardened, T mu, const T (&constants)[3]) {
    Flow<T> f;
    const entry<T> third2 = (entry<T>)(2.0 / 3), root = (entry<T>)0.816496580927726;
    UNROLL for (int k = 0; k < 6; ++k) {
        f.direction.m[k] = 2 * mu * (deviatoric.m[k] - plastic.m[k]) - third2 * constants[2] * plastic.m[k];
    }
    f.trial = sqrt(contraction(f.direction, f.direction));
    f.radius = root * (constants[0] + constants[1] * hardened);
    f.amount = larger(f.trial - f.radius, T{}) / (2 * mu + third2 * (constants[1] + constants[2]));
    const T inverse = 1 / (f.trial + (entry<T>)1e-30);
    UNROLL for (int k = 0; k < 6; ++k) f.direction.m[k] *= inverse;
    return f;
}

template <class T> INLINE void flow(const Flow<T>& f, symmetric6<T>& plastic) {
    UNROLL for (int k = 0; k < 6; ++k) plastic.m[k] += f.amount * f.direction.m[k];
}

struct PlasticHistory {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) where the last step ended [m]
    const local* gradients;  // (9, n) rest gradients of the shape functions of nodes 1, 2, 3, one after another [1/m]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes and in a frozen body
    const int* watched;      // (n,) a node of the element's body that is free unless the body is frozen
    const local* shear;      // (n,) mu [Pa]
    const local* constants;  // (3, n) [Pa]
    local* last;             // (4, n) in, out: constants and mu with which the last step ended, as they are now [Pa]
    local* plastic;          // (6, n) in, out: plastic strain
    local* hardened;         // (1, n) in, out: equivalent plastic strain
};

// Once a step.
KERNEL(advance, PlasticHistory) {
    typedef local_number T;
    index tet[4];
    const long long n = p.n;
    T constants[3], hardened = at_items(p.hardened, i);
    const T mu = at_items(p.last + 3 * n, i);
    UNROLL for (int k = 0; k < 3; ++k) {
        constants[k] = at_items(p.last + k * n, i);
        put(p.last + k * n, i, at_items(p.constants + k * n, i));
    }
    put(p.last + 3 * n, i, at_items(p.shear, i));
    symmetric6<T> plastic = symmetric_at(p.plastic, p.n, i);
    Flow<T> f = flow_to(deviator(turned_element_at(p, i, tet).strain), plastic, hardened, mu, constants);
    f.amount = is_live(p, i) ? f.amount : T{};
    flow(f, plastic);
    put_symmetric(p.plastic, p.n, i, plastic);
    put(p.hardened, i, hardened + (local)0.816496580927726 * f.amount);
}

struct PlasticElements {
    int n;                   // elements
    const int* tets;         // (n, 4) nodes
    const real* x;           // (nodes, 3) positions [m]
    const real* v;           // (nodes, 3) what the tangent is applied to: world.predictor [m/s]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* shear;      // (n,) [Pa]
    const local* constants;  // (3, n) [Pa]
    local h;                 // factor of the force [s]
    local tangent;           // factor of the tangent [s2]
    const local* plastic;    // (6, n) where the step began
    const local* hardened;   // (1, n) likewise
    local* corners;          // (4, n, 9) out: h f_a - tangent (K v)_a [N s], upper triangle of tangent K_aa [kg]
    local* edges;            // (6, n, 9) out: tangent K_ab, a < b [kg]
};

// What the flow takes from stress and stiffness of the elastic element.
KERNEL(elements, PlasticElements) {
    typedef local_number T;
    index tet[4];
    local_vec3 v[3], impulse[4], D[4];
    T constants[3], mu = at_items(p.shear, i);
    constants_at(p, i, constants);
    TurnedElement<T> e = turned_element_at(p, i, tet);
    field_edges(p.v, tet, v);
    symmetric6<T> stress = symmetric_at(p.plastic, p.n, i);
    const Flow<T> f = flow_to(deviator(e.strain), stress, at_items(p.hardened, i), mu, constants);
    flow(f, stress);
    const T modulus = mu, volume = at_items(p.volume, i);
    mu *= volume;
    UNROLL for (int k = 0; k < 6; ++k) stress.m[k] *= -2 * p.h * mu;
    impulses_of(e, without_torque(e, stress), impulse);
    world_gradients(e, D);

    const entry<T> least = (entry<T>)1e-3, rounding = single<T> ? (entry<T>)1e-3 : (entry<T>)1e-6;
    auto flows = f.trial - f.radius > rounding * f.radius;
    T hard = (constants[1] + constants[2]) / (3 * modulus), lost = smaller(2 * modulus * f.amount / (f.trial + (entry<T>)1e-30), T{} + 1 - least);
    T along = larger(1 / (1 + larger(hard, T{} + least)) - lost, T{});
    lost = flows ? p.tangent * mu * lost : T{};
    along = flows ? 2 * p.tangent * mu * along : T{};
    Blocks6<T> B = isotropic_blocks(D, (local)(2.0 / 3) * lost, -lost);
    const local_mat3 n = mul(e.R, whole(f.direction));
    UNROLL for (int k = 0; k < 3; ++k) D[k + 1] = mul(n, row(e.gradients, k));
    set_corner_0(D);
    UNROLL for (int edge = 0; edge < 6; ++edge) add_outer(B.e[edge], -along * D[edge_first(edge)], D[edge_second(edge)]);
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

struct PlasticEnergy {
    int n;                   // elements
    const int* tets;         // (n, 4)
    const real* x;           // (nodes, 3) [m]
    const local* gradients;  // (9, n) [1/m]
    const local* volume;     // (n,) [m3]
    const local* shear;      // (n,) [Pa]
    const local* constants;  // (3, n) [Pa]
    const local* plastic;    // (6, n)
    const local* hardened;   // (1, n)
    local* energy;           // (n,) out: V (mu (|e - plastic|^2 - |e|^2) + kinematic |plastic|^2 / 3) at the end of the step [J]
};

KERNEL(energy, PlasticEnergy) {
    typedef local_number T;
    index tet[4];
    T constants[3], mu = at_items(p.shear, i);
    constants_at(p, i, constants);
    symmetric6<T> now = deviator(turned_element_at(p, i, tet).strain), plastic = symmetric_at(p.plastic, p.n, i);
    flow(flow_to(now, plastic, at_items(p.hardened, i), mu, constants), plastic);
    T square = contraction(plastic, plastic);
    T density = mu * (square - 2 * contraction(now, plastic)) + (local)(1.0 / 3) * constants[2] * square;
    put(p.energy, i, at_items(p.volume, i) * density);
}
