// SPDX-License-Identifier: MIT
// W = lambda/2 tr^2 E + mu E : E with E = (F^T F - I) / 2: P = F S with S = lambda tr E I + 2 mu E, and
// d2W / dF_rk dF_cl = d_rc S_kl + lambda F_rk F_cl + mu (F_rl F_ck + (F F^T)_rc d_kl).
template <class T> INLINE void derivatives(const mat<T>& F, T lambda, T mu, mat<T>& P, T (&A)[81]) {
    mat<T> C = mul(transposed(F), F), B = mul(F, transposed(F)), S;
    T pressure = (entry<T>)0.5 * lambda * (trace(C) - 3);
    for (int k = 0; k < 9; ++k) S.m[k] = k % 4 == 0 ? pressure + mu * (C.m[k] - 1) : mu * C.m[k];
    P = mul(F, S);
    UNROLL for (int r = 0; r < 3; ++r) for (int k = 0; k < 3; ++k)
        for (int c = 0; c < 3; ++c) for (int l = 0; l < 3; ++l) {
            T a = lambda * F.m[3 * r + k] * F.m[3 * c + l] + mu * F.m[3 * r + l] * F.m[3 * c + k];
            if (r == c) a += S.m[3 * k + l];
            if (k == l) a += mu * B.m[3 * r + c];
            A[9 * (3 * r + k) + 3 * c + l] = a;
        }
}
