// SPDX-License-Identifier: MIT
// W = mu/2 (I1 - 3) - mu ln J + lambda/2 ln^2 J; G = F^-T: P = mu F + s G with s = lambda ln J - mu, and
// d2W / dF_rk dF_cl = mu d_rc d_kl + lambda G_rk G_cl - s G_rl G_ck.
template <class T> INLINE void derivatives(const mat<T>& F, T lambda, T mu, mat<T>& P, T (&A)[81]) {
    vec<T> f0 = row(F, 0), f1 = row(F, 1), f2 = row(F, 2), c0 = cross(f1, f2), c1 = cross(f2, f0), c2 = cross(f0, f1);
    T J = dot(f0, c0), inverse = 1 / J, s = lambda * log(J) - mu;
    const mat<T> G = {{inverse * c0.x, inverse * c0.y, inverse * c0.z, inverse * c1.x, inverse * c1.y, inverse * c1.z,
                       inverse * c2.x, inverse * c2.y, inverse * c2.z}};
    for (int k = 0; k < 9; ++k) P.m[k] = mu * F.m[k] + s * G.m[k];
    UNROLL for (int r = 0; r < 3; ++r) for (int k = 0; k < 3; ++k)
        for (int c = 0; c < 3; ++c) for (int l = 0; l < 3; ++l) {
            T a = lambda * G.m[3 * r + k] * G.m[3 * c + l] - s * G.m[3 * r + l] * G.m[3 * c + k];
            A[9 * (3 * r + k) + 3 * c + l] = r == c && k == l ? a + mu : a;
        }
}
