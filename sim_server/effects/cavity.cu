// SPDX-License-Identifier: MIT
// Closed cavities of bodies: volume, pressure, and the forces of the pressure on the wall (cavity.py).
#include "mat3.cuh"

struct Lids {
    int n;                  // cells: lids
    const int* start;       // (n + 1,) into node
    const int* node;        // (start[n],) around each opening
    const real* x;          // (nodes, 3) [m]
    const real* predictor;  // (nodes, 3) world.predictor [m/s]
    real* centre;           // (n, 6) out: means of both
};

KERNEL(lids, Lids) {
    vec3 x = {}, rate = {};
    for (int k = p.start[i]; k < p.start[i + 1]; ++k) {
        x = x + load3(p.x, p.node[k]);
        rate = rate + load3(p.predictor, p.node[k]);
    }
    const real share = (real)1 / (p.start[i + 1] - p.start[i]);
    store3(p.centre, 2 * i, share * x);
    store3(p.centre, 2 * i + 1, share * rate);
}

struct Walls {
    int n;                  // patches: triangles of walls and lids
    const int* corner;      // (n, 3) nodes, outward from the body by the right-hand rule; -1 - k: the centre of lid k
    const int* origin;      // (n,) a node of the cavity, from which volumes are measured
    const real* x;          // (nodes, 3) [m]
    const real* predictor;  // (nodes, 3) [m/s]
    const real* centre;     // (lids, 6) [m], [m/s]
    real* area;             // (n, 3) out: outward normal times area [m2]
    real* swept;            // (n, 2) out: part of the volume [m3], and of its rate by the predictor [m3/s]
};

KERNEL(walls, Walls) {
    const vec3 origin = load3(p.x, p.origin[i]), still = load3(p.predictor, p.origin[i]);
    vec3 x[3], sum = {};
    for (int k = 0; k < 3; ++k) {
        const int c = p.corner[3 * i + k];
        x[k] = (c < 0 ? load3(p.centre, 2 * (-1 - c)) : load3(p.x, c)) - origin;
        sum = sum + ((c < 0 ? load3(p.centre, 2 * (-1 - c) + 1) : load3(p.predictor, c)) - still);
    }
    const vec3 area = (real)0.5 * cross(x[1] - x[0], x[2] - x[0]);
    store3(p.area, i, area);
    p.swept[2 * i] = -dot(x[0], cross(x[1], x[2])) / 6;
    p.swept[2 * i + 1] = -dot(area, sum) / 3;
}

struct Chunks {
    int n;              // elements: runs of triangles of one cavity
    const int* start;   // (n + 1,) into triangles
    const real* swept;  // (triangles, 2)
    real* sum;          // (n, 2) out
};

INLINE void chunks_add(const Chunks& p, int, int k, local* sum) {
    sum[0] += p.swept[2 * k];
    sum[1] += p.swept[2 * k + 1];
}

INLINE void chunks_put(const Chunks& p, int i, const local* sum) {
    p.sum[2 * i] = sum[0];
    p.sum[2 * i + 1] = sum[1];
}

SUM_KERNEL(chunks, Chunks, 2)

struct Slopes {
    int n;                // elements: nodes of one cavity after another
    const int* start;     // (n + 1,) into the entries
    const int* triangle;  // (start[n],) of each entry
    const real* share;    // (start[n],) that the node has of it: 1/3, less of triangles of lids
    const real* area;     // (triangles, 3) [m2]
    real* slope;          // (n, 3) out: derivative u of the volume by the node's position [m2]
};

INLINE void slopes_add(const Slopes& p, int, int k, local* sum) {
    const vec3 area = load3(p.area, p.triangle[k]);
    sum[0] -= p.share[k] * area.x;
    sum[1] -= p.share[k] * area.y;
    sum[2] -= p.share[k] * area.z;
}

INLINE void slopes_put(const Slopes& p, int i, const local* sum) {
    for (int m = 0; m < 3; ++m) p.slope[3 * i + m] = sum[m];
}

SUM_KERNEL(slopes, Slopes, 3)

enum CavityMode { GIVEN = 0, GAS = 1, LIQUID = 2 };

struct Pressures {
    int n;              // corners: cavities
    const int* start;   // (n + 1,) into chunks
    const real* sum;    // (chunks, 2)
    const int* mode;    // (n,) CavityMode
    const real* law;    // (n, 5) pressure [Pa], amount [-] or volume [m3]; exponent [-], ambient [Pa], bulk [Pa], V0 [m3]
    real h;             // world.force_coefficient [s]
    real dx_dv;         // world.dx_dv [s]
    int implicit;       // 1: A has h dx_dv (-dp/dV) u u^T; 0: explicit substeps
    real* state;        // (n, 4) out: V [m3], p [Pa], h dx_dv (-dp/dV) [kg/m4], and its impulse by the predictor [Pa s]
};

// Gauge pressure and -dp/dV. Below a thousandth of V0 a gas keeps the pressure that it has there.
INLINE real gas_pressure(const real* law, real V, real* slope) {
    const real least = (real)1e-3 * law[4], held = V > least ? V : least;
    const real absolute = law[2] * law[0] * exp(law[1] * log(law[4] / held));
    *slope = V > least ? law[1] * absolute / V : (real)0;
    return absolute - law[2];
}

INLINE void pressures_add(const Pressures& p, int, int k, local* sum) {
    sum[0] += p.sum[2 * k];
    sum[1] += p.sum[2 * k + 1];
}

INLINE void pressures_put(const Pressures& p, int i, const local* sum) {
    const real *law = p.law + 5 * i, V = sum[0];
    real pressure = law[0], slope = 0;
    if (p.mode[i] == GAS) pressure = gas_pressure(law, V, &slope);
    if (p.mode[i] == LIQUID) {
        slope = law[3] / law[4];
        pressure = slope * (law[0] - V);
    }
    const real scale = p.implicit ? p.h * p.dx_dv * slope : (real)0;
    p.state[4 * i] = V;
    p.state[4 * i + 1] = pressure;
    p.state[4 * i + 2] = scale;
    p.state[4 * i + 3] = -scale * sum[1];
}

SUM_KERNEL(pressures, Pressures, 2)

struct CavityLoad {
    int n;               // nodes
    const int* start;    // (n + 1,) into the entries
    const int* row;      // (start[n],) of slope
    const int* cavity;   // (start[n],)
    const real* slope;   // (rows, 3) [m2]
    const real* state;   // (cavities, 4)
    const int* mode;     // (cavities,)
    real h;              // world.force_coefficient [s]
    int accumulate;      // 0: write load, 1: add to what another effect wrote
    own<real> b;         // (n, 3) in, out: += h f - h dx_dv K predictor [N s]
    real* load;          // (n, 3) out: f of given pressures, for the energy balance [N]
};

INLINE void load_add(const CavityLoad& p, int, int k, local* sum) {
    const int c = p.cavity[k];
    const real *u = p.slope + 3 * p.row[k], pressure = p.state[4 * c + 1], impulse = p.h * pressure + p.state[4 * c + 3];
    for (int m = 0; m < 3; ++m) {
        sum[m] += impulse * u[m];
        if (p.mode[c] == GIVEN) sum[3 + m] += pressure * u[m];
    }
}

INLINE void load_put(const CavityLoad& p, int i, const local* sum) {
    store3(p.b, i, load3(p.b, i) + vec3{sum[0], sum[1], sum[2]});
    for (int m = 0; m < 3; ++m) p.load[3 * i + m] = p.accumulate ? p.load[3 * i + m] + sum[3 + m] : sum[3 + m];
}

SUM_KERNEL(load, CavityLoad, 6)

struct CavityEnergy {
    int n;               // corners: cavities
    const int* first;    // (n + 1,) into triangles
    const int* corner;   // (triangles, 3)
    const int* origin;   // (triangles,)
    const int* start;    // (lids + 1,) into node
    const int* node;
    const real* x;       // (nodes, 3) [m]
    const int* mode;     // (n,)
    const real* law;     // (n, 5)
    real* energy;        // (n,) out: of gas and liquid against the pressure outside, 0 where they have that [J]
};

INLINE vec3 corner_of(const CavityEnergy& p, int c) {
    if (c >= 0) return load3(p.x, c);
    vec3 sum = {};
    const int first = p.start[-1 - c], last = p.start[-c];
    for (int k = first; k < last; ++k) sum = sum + load3(p.x, p.node[k]);
    return ((real)1 / (last - first)) * sum;
}

// Of p V^n = const from V = V0 to V0 exp(-L), over the pressure and volume at V0. more: n - 1
INLINE real gas_work(real more, real L) { return magnitude(more) > (real)1e-6 ? (exp(more * L) - 1) / more : L; }

KERNEL(energy, CavityEnergy) {
    const real* law = p.law + 5 * i;
    real V = 0;
    for (int k = p.first[i]; k < p.first[i + 1]; ++k) {
        const vec3 origin = load3(p.x, p.origin[k]);
        const vec3 x = corner_of(p, p.corner[3 * k]) - origin, y = corner_of(p, p.corner[3 * k + 1]) - origin;
        V -= dot(x, cross(y, corner_of(p, p.corner[3 * k + 2]) - origin)) / 6;
    }
    real energy = 0;
    if (p.mode[i] == GAS) {
        const real least = (real)1e-3 * law[4], held = V > least ? V : least;
        const real L = log(law[4] / held), free = -log(law[0]) / law[1];  // where the pressure is that outside
        real slope;
        energy = law[2] * (law[0] * law[4] * (gas_work(law[1] - 1, L) - gas_work(law[1] - 1, free)) + held - law[4] * exp(-free));
        energy += gas_pressure(law, V, &slope) * (held - V);
    }
    if (p.mode[i] == LIQUID) energy = (real)0.5 * law[3] / law[4] * (V - law[0]) * (V - law[0]);
    p.energy[i] = energy;
}
