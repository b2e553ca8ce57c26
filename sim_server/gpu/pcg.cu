// SPDX-License-Identifier: MIT
// Preconditioned conjugate gradients of all bodies in one persistent launch, numbered as native/pcg.h, which it mirrors.
//
// A body is solved by a group of thread blocks with a barrier of its own; blocks beyond what the bodies need do nothing,
// bodies beyond the blocks queue. Two barriers an iteration: the search direction p = z + beta p is formed while A p is
// computed (every block forms what it reads), and x, r are updated while the preconditioner is applied. All sums have a
// fixed order: no float atomics, the same bits every time.
//
// The factor is applied as the dense inverse in float16, made on the device from L (expand.py): data without dependency
// chains. Vectors and A are float64, so that the residual is, whatever the preconditioner's precision.
#include "invert3.cuh"

#define THREADS 512
#define WARPS (THREADS / 32)
#define LANES_PER_NODE 16
#define ALL 0xffffffffu

enum Kind { NONE = 0, JACOBI = 1, BLOCK_JACOBI = 2, CHOLESKY = 3 };
enum Status { CONVERGED = 0, MAX_ITERATIONS = 1, BUDGET = 2, BREAKDOWN_MATRIX = 3, BREAKDOWN_PRECONDITIONER = 4, NOT_FINITE = 5 };

struct Body {
    int first, nodes;                // of the scene's nodes
    int block, blocks;               // thread blocks [block, block + blocks) solve it
    int kind, max_iterations, warm_start, probe;
    double tolerance;
    const unsigned short* inverse;   // (3 nodes, stride) float16, or null
    long long factor_step;           // of the matrix it was made from
    const float* scale;              // (3 nodes,) d: the inverse is d_i stored_ij d_j, entries of at most 1
    int stride, unused;              // entries per row, a multiple of 8, zeros beyond 3 nodes
};

struct Result {
    double residual;                 // true, relative
    double seconds;
    long long factor_step;           // -1: no factor used
    int iterations, status, kind, asked, fallbacks, bad_node;
};

struct Solve {
    const Body* bodies;
    int count, capacity;             // bodies; results kept per body
    const int* row_start;
    const int* columns;
    const double* values;            // (blocks, 3, 3)
    const double* b;                 // (nodes, 3)
    double* y;                       // (nodes, 3) start in, solution out
    double* r;                       // (2, nodes, 3)
    double* p;                       // (2, nodes, 3)
    double* z;                       // (nodes, 3)
    double* q;                       // (nodes, 3)
    double* diagonal;                // (nodes, 9) inverses of the diagonal blocks
    double* partial;                 // (bodies, 2, grid, 2) sums of the thread blocks
    unsigned* arrived;               // (bodies,) zero at launch
    const long long* step;           // completed steps: where the result goes
    Result* results;                 // (capacity, bodies)
    int nodes, shared;               // of the scene; bytes of dynamic shared memory
};

extern __shared__ float4 dynamic[];   // the residual in float32 (dense inverse), then the own rows of A where they fit

struct Group {
    const Solve& s;
    const Body body;
    const int index, lane, warp;     // of this block in the group, of this thread
    const int begin, end;            // own nodes, from 0 in the body
    unsigned target;
    int parity;                      // of the partial sums
    unsigned* const arrived;
    double* const partial;           // of this body
    double* const scratch;           // shared, 2 WARPS + 2
    const int* row_start;            // of the own rows: here or in global memory, from row `row_base`
    const int* columns;
    const double* values;
    int row_base, block_base;

    __device__ __forceinline__ float* residual32() { return (float*)dynamic; }

    // Copies the own rows of A into shared memory if they fit: loads after a barrier miss L1.
    __device__ __forceinline__ void bring_rows(int bytes, int capacity) {
        int first = body.first + begin, count = end - begin;
        int low = s.row_start[first], blocks = s.row_start[body.first + end] - low;
        row_start = s.row_start; columns = s.columns; values = s.values;
        row_base = body.first; block_base = 0;
        if (bytes + 72 * blocks + 4 * (blocks + count + 1) + 16 > capacity) return;
        double* v = (double*)((char*)dynamic + bytes);
        int *c = (int*)(v + 9 * blocks), *r = c + blocks;
        for (int k = threadIdx.x; k < 9 * blocks; k += THREADS) v[k] = s.values[9ll * low + k];
        for (int k = threadIdx.x; k < blocks; k += THREADS) c[k] = s.columns[low + k];
        for (int k = threadIdx.x; k <= count; k += THREADS) r[k] = s.row_start[first + k];
        row_start = r; columns = c; values = v;
        row_base = -begin; block_base = low;
        __syncthreads();
    }

    __device__ __forceinline__ void barrier() {
        __syncthreads();
        if (body.blocks == 1) return;
        target += body.blocks;
        if (threadIdx.x == 0) {
            unsigned seen;
            asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(arrived) : "memory");
            do asm volatile("ld.relaxed.gpu.global.u32 %0, [%1];" : "=r"(seen) : "l"(arrived) : "memory");
            while ((int)(seen - target) < 0);
            asm volatile("fence.acq_rel.gpu;" ::: "memory");  // once: an acquiring load would flush L1 at every turn
        }
        __syncthreads();
    }

    static __device__ __forceinline__ void warp_sum(double& a, double& c, int from) {
        for (int k = from; k; k >>= 1) {
            a += __shfl_xor_sync(ALL, a, k);
            c += __shfl_xor_sync(ALL, c, k);
        }
    }

    // Sums over the threads of this block, in every thread.
    __device__ __forceinline__ void block_sum(double& a, double& c) {
        warp_sum(a, c, 16);
        __syncthreads();
        if (lane == 0) { scratch[warp] = a; scratch[WARPS + warp] = c; }
        __syncthreads();
        a = scratch[lane % WARPS];
        c = scratch[WARPS + lane % WARPS];
        warp_sum(a, c, WARPS / 2);
    }

    // Sums over the group, in every thread; a barrier.
    __device__ __forceinline__ void group_sum(double& a, double& c) {
        block_sum(a, c);
        if (body.blocks == 1) { __syncthreads(); return; }
        double2* mine = (double2*)partial + parity * gridDim.x;
        if (threadIdx.x == 0) __stcg(mine + index, make_double2(a, c));
        barrier();
        if (warp == 0) {  // one warp a block: all of them would queue for the same few lines of L2
            a = 0; c = 0;
            for (int k = lane; k < body.blocks; k += 32) {
                double2 sums = __ldcg(mine + k);
                a += sums.x;
                c += sums.y;
            }
            warp_sum(a, c, 16);
            if (lane == 0) { scratch[2 * WARPS] = a; scratch[2 * WARPS + 1] = c; }
        }
        __syncthreads();
        a = scratch[2 * WARPS];
        c = scratch[2 * WARPS + 1];
        parity ^= 1;
    }

    // One row of blocks times a vector that is formed on the way: u + beta w. 16 lanes a node; the sum ends in lane 0 of them.
    __device__ __forceinline__ void row_product(int node, int sub, const double* u, const double* w, double beta, double sum[3]) {
        sum[0] = sum[1] = sum[2] = 0;
        if (node < end) {
            int row = row_base + node;
            for (int k = row_start[row] - block_base + sub; k < row_start[row + 1] - block_base; k += LANES_PER_NODE) {
                const double* a = values + 9ll * k;
                const double* uj = u + 3ll * columns[k];
                double v0 = __ldcg(uj), v1 = __ldcg(uj + 1), v2 = __ldcg(uj + 2);
                if (w) {
                    const double* wj = w + 3ll * columns[k];
                    v0 += beta * __ldcg(wj); v1 += beta * __ldcg(wj + 1); v2 += beta * __ldcg(wj + 2);
                }
                sum[0] += a[0] * v0 + a[1] * v1 + a[2] * v2;
                sum[1] += a[3] * v0 + a[4] * v1 + a[5] * v2;
                sum[2] += a[6] * v0 + a[7] * v1 + a[8] * v2;
            }
        }
        for (int k = LANES_PER_NODE / 2; k; k >>= 1)
            for (int m = 0; m < 3; ++m) sum[m] += __shfl_down_sync(ALL, sum[m], k, LANES_PER_NODE);
    }

    // r = b - A y; returns |r|^2, and |b|^2 in `bb`.
    __device__ __forceinline__ double residual(double* r, double& bb) {
        double rr = 0, sum[3];
        bb = 0;
        int sub = threadIdx.x % LANES_PER_NODE, each = THREADS / LANES_PER_NODE;
        for (int base = begin; base < end; base += each) {
            int node = base + threadIdx.x / LANES_PER_NODE;
            row_product(node, sub, s.y, nullptr, 0, sum);
            if (node < end && sub == 0)
                for (int m = 0; m < 3; ++m) {
                    long long i = 3ll * (body.first + node) + m;
                    double d = s.b[i] - sum[m];
                    r[i] = d;
                    rr += d * d;
                    bb += s.b[i] * s.b[i];
                }
        }
        group_sum(rr, bb);
        return rr;
    }

    // q = A p with p = z + beta p_old, kept; returns p . q.
    __device__ __forceinline__ double direction(double beta, const double* old, double* p) {
        double pq = 0, none = 0, sum[3];
        int sub = threadIdx.x % LANES_PER_NODE, each = THREADS / LANES_PER_NODE;
        for (int base = begin; base < end; base += each) {
            int node = base + threadIdx.x / LANES_PER_NODE;
            row_product(node, sub, s.z, beta != 0 ? old : nullptr, beta, sum);
            if (node < end && sub == 0)
                for (int m = 0; m < 3; ++m) {
                    long long i = 3ll * (body.first + node) + m;
                    double v = __ldcg(s.z + i) + (beta != 0 ? beta * __ldcg(old + i) : 0);
                    p[i] = v;
                    s.q[i] = sum[m];
                    pq += v * sum[m];
                }
        }
        group_sum(pq, none);
        return pq;
    }

    // x += alpha p and r -= alpha q for the own nodes; alpha 0: nothing to add yet (p and q hold nothing).
    __device__ __forceinline__ double update(long long i, double alpha, const double* p, const double* r_old, double* r_new) {
        double d = __ldcg(r_old + i);
        if (alpha != 0) {
            d -= alpha * __ldcg(s.q + i);
            s.y[i] += alpha * p[i];
        }
        r_new[i] = d;
        return d;
    }

    // z = P^-1 r by diagonal blocks, r updated on the way; returns z . r, and |r|^2 in `rr`.
    __device__ __forceinline__ double by_blocks(int kind, double alpha, const double* p, const double* r_old, double* r_new, double& rr) {
        double rz = 0;
        rr = 0;
        for (int node = begin + threadIdx.x; node < end; node += THREADS) {
            long long i = 3ll * (body.first + node);
            double d[3];
            for (int m = 0; m < 3; ++m) d[m] = update(i + m, alpha, p, r_old, r_new);
            const double* v = s.diagonal + 3 * i;
            for (int m = 0; m < 3; ++m) {
                double zi = kind == NONE ? d[m] : v[3 * m] * d[0] + v[3 * m + 1] * d[1] + v[3 * m + 2] * d[2];
                s.z[i + m] = zi;
                rz += zi * d[m];
                rr += d[m] * d[m];
            }
        }
        group_sum(rz, rr);
        return rz;
    }

    // Two float16 times two float32.
    static __device__ __forceinline__ float two(unsigned halves, float x, float y) {
        float lo, hi;
        asm("{.reg .b16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
            : "=f"(lo), "=f"(hi) : "r"(halves));
        return lo * x + hi * y;
    }

    // z = P^-1 r by the dense inverse. Every block forms all of r (a barrier less), then the rows of z that are its warps'.
    __device__ __forceinline__ double by_inverse(double alpha, const double* p, const double* r_old, double* r_new, double goal, double& rr) {
        int n = 3 * body.nodes;
        long long base = 3ll * body.first;
        double rz = 0, none = 0;
        rr = 0;
        float* shared_r = residual32();
        for (int k = threadIdx.x; k < body.stride; k += THREADS) {
            double d = 0;
            if (k < n) {
                d = __ldcg(r_old + base + k);
                if (alpha != 0) d -= alpha * __ldcg(s.q + base + k);
            }
            shared_r[k] = k < n ? body.scale[k] * (float)d : 0;
            rr += d * d;
        }
        for (int k = 3 * begin + threadIdx.x; k < 3 * end; k += THREADS) update(base + k, alpha, p, r_old, r_new);
        block_sum(rr, none);  // the same in every block, to the bit
        if (rr <= goal) {
            barrier();
            return 1;
        }
        int warps = WARPS * body.blocks;
        for (int row = WARPS * index + warp; row < n; row += warps) {
            const uint4* a = (const uint4*)(body.inverse + (long long)row * body.stride);
            float sum = 0;
            for (int k = lane; k < body.stride / 8; k += 32) {
                uint4 v = a[k];
                float4 x = dynamic[2 * k], y = dynamic[2 * k + 1];
                sum += two(v.x, x.x, x.y) + two(v.y, x.z, x.w) + two(v.z, y.x, y.y) + two(v.w, y.z, y.w);
            }
            for (int k = 16; k; k >>= 1) sum += __shfl_down_sync(ALL, sum, k);
            if (lane == 0) {
                s.z[base + row] = (double)body.scale[row] * sum;
                rz += (double)sum * shared_r[row];
            }
        }
        none = 0;
        group_sum(rz, none);
        return rz;
    }

    __device__ __forceinline__ void invert_diagonal(bool whole) {
        for (int node = begin + threadIdx.x; node < end; node += THREADS) {
            int row = body.first + node, k = s.row_start[row];
            while (s.columns[k] != row) ++k;
            invert3(s.values + 9ll * k, whole, s.diagonal + 9ll * row);
        }
    }

    __device__ __forceinline__ void set(double* to, const double* from) {
        for (int k = 3 * begin + threadIdx.x; k < 3 * end; k += THREADS)
            to[3ll * body.first + k] = from ? from[3ll * body.first + k] : 0;
    }
};

__device__ long long nanoseconds() {
    long long t;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(t));
    return t;
}

__device__ Result solve(Group& g) {
    const Solve& s = g.s;
    const Body& body = g.body;
    long long all = 3ll * s.nodes;
    int kind = body.kind == CHOLESKY && !body.inverse ? BLOCK_JACOBI : body.kind;
    Result out = {0, 0, -1, 0, CONVERGED, kind, body.kind, 0, -1};
    int turn = 0;  // which half of r holds the residual
    double b2, r2 = g.residual(s.r, b2), none;
    double goal = body.tolerance * body.tolerance * b2;
    if (!isfinite(b2)) {
        g.set(s.y, nullptr);
        out.status = NOT_FINITE;
        out.residual = b2;
        return out;
    }
    if (!body.warm_start || !(r2 < b2)) {
        g.set(s.y, nullptr);
        g.set(s.r, s.b);
        r2 = b2;
    }
    if (r2 <= goal) {
        out.residual = b2 > 0 ? sqrt(r2 / b2) : 0;
        return out;
    }
    if (kind == JACOBI || kind == BLOCK_JACOBI) g.invert_diagonal(kind == BLOCK_JACOBI);
    g.barrier();

    double alpha = 0, rz = 0, last = 1e300, quarter = r2 * pow(goal / r2, 0.25);
    bool restart = true, switched = false;
    for (int way = 0;; ) {
        double *r_old = s.r + turn * all, *r_new = s.r + (1 - turn) * all, *p = s.p + way * all;
        double zr = kind == CHOLESKY ? g.by_inverse(alpha, p, r_old, r_new, goal, r2)
                                     : g.by_blocks(kind, alpha, p, r_old, r_new, r2);
        turn = 1 - turn;
        int stop = -1;
        if (r2 <= goal) stop = CONVERGED;
        else if (!(zr > 0 && zr < 1e300)) stop = BREAKDOWN_PRECONDITIONER;
        else if (out.iterations == body.max_iterations) stop = MAX_ITERATIONS;
        else if (kind == CHOLESKY && out.iterations > 0 && out.iterations == body.max_iterations / 2 && !(r2 < quarter))
            stop = BREAKDOWN_PRECONDITIONER;  // not a quarter of the way: pcg.h says why
        if (stop == BREAKDOWN_PRECONDITIONER && kind == CHOLESKY) {  // a useless factor: on with block Jacobi
            kind = out.kind = BLOCK_JACOBI;
            out.fallbacks = 1;
            g.invert_diagonal(true);
            alpha = 0;
            restart = true;
            g.barrier();
            continue;
        }
        if (stop < 0 && body.probe > 0 && out.iterations == body.probe && body.inverse && kind >= BLOCK_JACOBI && !switched) {
            kind = out.kind = kind == CHOLESKY ? BLOCK_JACOBI : CHOLESKY;
            if (kind == BLOCK_JACOBI) g.invert_diagonal(true);
            alpha = 0;
            switched = restart = true;
            g.barrier();
            continue;
        }
        if (stop < 0) {
            double pq = g.direction(restart ? 0 : zr / rz, p, s.p + (1 - way) * all);
            way = 1 - way;
            rz = zr;
            restart = false;
            ++out.iterations;
            if (pq > 0) { alpha = rz / pq; continue; }
            stop = BREAKDOWN_MATRIX;
        }
        g.barrier();
        r2 = g.residual(s.r + turn * all, none);
        if (stop == CONVERGED && r2 > goal) {  // the recursive residual was too good
            if (r2 < 0.25 * last) {
                last = r2;
                alpha = 0;
                restart = true;
                continue;
            }
            stop = MAX_ITERATIONS;
        }
        out.status = stop;
        out.residual = sqrt(r2 / b2);
        return out;
    }
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) pcg(const Solve s) {
    __shared__ double scratch[2 * WARPS + 2];
    for (int k = 0; k < s.count; ++k) {
        int block = s.bodies[k].block;
        if ((int)blockIdx.x < block || (int)blockIdx.x >= block + s.bodies[k].blocks) continue;
        const Body body = s.bodies[k];
        int index = blockIdx.x - body.block;
        Group g = {s, body, index, (int)threadIdx.x % 32, (int)threadIdx.x / 32,
                   (int)((long long)body.nodes * index / body.blocks), (int)((long long)body.nodes * (index + 1) / body.blocks),
                   0, 0, s.arrived + k, s.partial + 4ll * gridDim.x * k, scratch};
        long long begin = nanoseconds();
        g.bring_rows(4 * body.stride, s.shared);
        Result out = solve(g);
        if (index == 0 && threadIdx.x == 0) {
            out.seconds = 1e-9 * (nanoseconds() - begin);
            if (out.kind == CHOLESKY || out.fallbacks) out.factor_step = body.factor_step;
            s.results[(s.step[0] % s.capacity) * s.count + k] = out;
        }
        __syncthreads();
    }
}
