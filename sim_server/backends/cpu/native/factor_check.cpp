// SPDX-License-Identifier: MIT
// What one application of a factor says about it, beside one of block Jacobi. For the service thread; no loop calls this.
#include "pcg.h"
#include "sizes.h"

extern "C" {

enum Part { WITH_FACTOR = 1, WITH_BLOCK_JACOBI = 2 };

// A: of one body, its nodes numbered from 0; values null: unknown. r: probe vector. work: 8 size entries. parts: of Part.
// out: z.r and z.Az with the factor, then both with block Jacobi, and |r - Az| / |r| with the factor; without a matrix only the
// first is written. applied: z, where the factor has been applied already: its values may be null then.
void wf_judge(int parts, const Factor* factor, int32_t nodes, const int32_t* row_start, const int32_t* columns, const double* values,
              const double* r, const double* applied, double* work, double* out) {
    BlockCsr A{0, nodes, row_start, columns, values};
    const int n = A.size();
    double *z = work, *q = z + n, *inverse = q + n, *scratch = inverse + 3 * n;
    Preconditioner P{A, factor, CHOLESKY, inverse, scratch, 1};
    if (parts & WITH_FACTOR) {
        if (applied) {
            std::copy(applied, applied + n, z);
            out[0] = dot(n, z, r);
        } else {
            out[0] = P.apply(r, std::sqrt(dot(n, r, r)), z);
        }
        if (values) {
            out[1] = multiply(A, z, q);
            double left = 0;
            for (int i = 0; i < n; ++i) left += (r[i] - q[i]) * (r[i] - q[i]);
            out[4] = std::sqrt(left / dot(n, r, r));
        }
    }
    if (!values || !(parts & WITH_BLOCK_JACOBI)) return;
    P.kind = BLOCK_JACOBI;
    P.prepare();
    out[2] = P.apply(r, 1, z);
    out[3] = multiply(A, z, q);
}

// The same of `count` factors, one after another; entry i of each array is of factor i. work: for the largest of them. out: (count, 5)
void wf_judge_all(int32_t count, int32_t parts, const Factor* factors, const int32_t* nodes, const int32_t* const* row_start,
                  const int32_t* const* columns, const double* const* values, const double* const* r, const double* const* applied,
                  double* work, double* out) {
    for (int i = 0; i < count; ++i)
        wf_judge(parts, factors + i, nodes[i], row_start[i], columns[i], values[i], r[i], applied[i], work, out + 5 * i);
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(Factor), SIZE(Pattern), {}};
    return sizes;
}
}
