// SPDX-License-Identifier: MIT
// What a tetrahedron of a law W(I1, I2, J) stores once the slopes of W and its impulses are known. HAS, REFUSES: of the law's text.
#pragma once
#include "hyperelastic.cuh"
#include "invariants.cuh"

// k: factor of the tangent times the volume; v: edges of the field that the tangent is applied to; impulse: h f_a, without K v.
template <unsigned HAS, bool REFUSES, class P, class T>
INLINE void put_element(const P& p, index i, const Tetrahedron<T>& t, const Invariants<T>& q, const Slopes<T>& w, const mat<T>& left,
                        T k, T floor, const vec<T> (&v)[3], vec<T> (&impulse)[4]) {
    Blocks6<T> B;
    invariant_edges<HAS>(w, q, left, t, k, B);
    if (p.projection != NONE) {
        auto wrong = indefinite(B);
        if (any(wrong)) {
            Principal<T> frame = principal(t.F);
            lift_modes(frame, modes<HAS>(w, frame.s), p.projection, wrong, k, t.D, B);
        }
    }
    if constexpr (REFUSES) {
        auto here = t.J <= 0 && floor == 0;
        note_refusal(here, p.refused, i, p.clock[0], t.J);
        refuse(here, B, impulse);
    }
    store_element(B, impulse, v, p.corners, p.edges, p.n, i);
}

// The impulses alone.
template <bool REFUSES, class P, class T> INLINE void put_impulses(const P& p, index i, T J, T floor, vec<T> (&impulse)[4]) {
    if constexpr (REFUSES) {
        auto here = J <= 0 && floor == 0;
        Blocks6<T> none = {};
        note_refusal(here, p.refused, i, p.clock[0], J);
        refuse(here, none, impulse);
    }
    UNROLL for (int a = 0; a < 4; ++a) put_row(p.impulses + 3 * (long long)p.n * a, i, p.n, {impulse[a].x, impulse[a].y, impulse[a].z});
}
