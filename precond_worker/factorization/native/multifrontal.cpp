// SPDX-License-Identifier: MIT
// Multifrontal Cholesky factorization of a symmetric matrix of 3x3 blocks on one thread (Duff and Reid, The multifrontal
// solution of indefinite sparse symmetric linear equations, 1983; Liu, The multifrontal method for sparse matrix solution:
// theory and practice, 1992). Fronts come in postorder. A front's own columns (the panel) are the sum of its entries of A and
// of its children's update matrices; eliminating them leaves columns of L, which go out at once, and
// U = -L21 L21^T + what is left of the children's updates.
//
// Update matrices lie on two stacks, used in turn by depth: children are popped from one while their parent is pushed on the
// other, so that nothing is moved. Fronts that fit the cache are eliminated by `tile` below, which keeps 3 columns of the
// result in registers; larger ones by LAPACK and BLAS. Integers for these are 64 bits wide and not negative: on a
// little-endian machine they can be read as 32 bits as well.
#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <vector>

#if defined(__AVX512F__)
constexpr int BYTES = 64;  // of a register
#elif defined(__AVX__)
constexpr int BYTES = 32;
#else
constexpr int BYTES = 16;
#endif
constexpr int64_t CACHED = 96 * 1024;  // bytes of L21 up to which `tile` is faster than a BLAS that copies its operands
constexpr int64_t NARROW = 64;          // columns, likewise

template <class T> struct Lanes;
template <> struct Lanes<double> { typedef double type __attribute__((vector_size(BYTES), aligned(8), may_alias)); };
template <> struct Lanes<float> { typedef float type __attribute__((vector_size(BYTES), aligned(4), may_alias)); };
template <class T> using lanes = typename Lanes<T>::type;
template <class T> constexpr int V = BYTES / sizeof(T);

struct Fronts {                 // in postorder; counts and places in nodes
    int64_t count, nodes;
    const int32_t* own;         // (count,) columns that a front eliminates
    const int32_t* height;      // (count,) its rows, own ones included
    const int32_t* parent;      // (count,) -1: none
    const int64_t* run_start;   // (count + 1,) runs of rows below the own ones that are adjacent in the parent as well
    const int32_t* run;         // (runs, 2) place of the first in the parent's rows, length
    const int64_t* entry_start; // (nodes + 1,) blocks of A of each column, that of the diagonal first
    const int32_t* entry_block; // number of the block
    const int32_t* entry_row;   // its place in the rows of the front
    const int64_t* row_start;   // (count + 1,), rows: degrees of freedom of the rows of each front
    const int32_t* rows;
};

using Potrf = void (*)(const char*, int64_t*, void*, int64_t*, int64_t*);
using Trsm = void (*)(const char*, const char*, const char*, const char*, int64_t*, int64_t*, void*, void*, int64_t*, void*,
                      int64_t*);
using Syrk = void (*)(const char*, const char*, int64_t*, int64_t*, void*, void*, int64_t*, void*, void*, int64_t*);

struct Library { Potrf potrf; Trsm trsm; Syrk syrk; };  // of one precision

enum Outcome : int64_t { MADE, NOT_FINITE, PIVOT, RANGE, MEMORY };

struct Result {
    int64_t outcome, column;  // column: where a pivot is not positive, or the factor is out of the range of its type
    int64_t negative;         // pivots turned positive
    double least;             // smallest pivot over the largest entry of its node's diagonal in A
};

static int64_t padded(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

template <class T> struct Memory {
    std::unique_ptr<char[]> held;
    T* at = nullptr;
    size_t size = 0;
    T* of(size_t n) {  // n entries and what `tile` may read past them; begins at a multiple of 64 bytes
        if (n > size || !at) {
            held.reset();
            held.reset(new char[(n + 8 * V<T>) * sizeof(T) + 64]);
            at = (T*)(((uintptr_t)held.get() + 63) / 64 * 64);
            std::memset((void*)at, 0, (n + 8 * V<T>) * sizeof(T));
            size = n;
        }
        return at;
    }
};

template <class T> struct Work {
    Memory<T> panel, scaled, stack[2];
    std::vector<T> sign;
};

struct Multifrontal {
    Fronts fronts;
    std::vector<int64_t> at;       // of each update matrix in its stack
    std::vector<int8_t> side;      // that stack
    std::vector<int32_t> children; // how many
    std::vector<int32_t> waiting[2];
    Work<double> wide;
    Work<float> narrow;
    std::vector<double> growth;
};

// c (R V rows, 3 columns) = (ADD ? c : 0) - a b^T, a (rows, k), b (3, k), by columns.
template <class T, int R, bool ADD>
static inline void tile(const T* a, int64_t lda, const T* b, int64_t ldb, int64_t k, T* c, int64_t ldc) {
    lanes<T> sum[R][3] = {};
    for (int64_t p = 0; p < k; ++p, a += lda, b += ldb) {
        const lanes<T> x = b[0] - lanes<T>{}, y = b[1] - lanes<T>{}, z = b[2] - lanes<T>{};
        for (int r = 0; r < R; ++r) {
            const lanes<T> w = *(const lanes<T>*)(a + r * V<T>);
            sum[r][0] += w * x;
            sum[r][1] += w * y;
            sum[r][2] += w * z;
        }
    }
    for (int j = 0; j < 3; ++j)
        for (int r = 0; r < R; ++r) {
            lanes<T>& to = *(lanes<T>*)(c + j * ldc + r * V<T>);
            to = ADD ? to - sum[r][j] : -sum[r][j];
        }
}

// The same for any number of rows, rounded up to whole vectors.
template <class T, bool ADD>
static void strip(int64_t rows, const T* a, int64_t lda, const T* b, int64_t ldb, int64_t k, T* c, int64_t ldc) {
    int64_t r = 0;
    for (; r + 3 * V<T> < rows; r += 4 * V<T>) tile<T, 4, ADD>(a + r, lda, b, ldb, k, c + r, ldc);
    const int64_t left = rows - r;
    if (left > 2 * V<T>) tile<T, 3, ADD>(a + r, lda, b, ldb, k, c + r, ldc);
    else if (left > V<T>) tile<T, 2, ADD>(a + r, lda, b, ldb, k, c + r, ldc);
    else if (left > 0) tile<T, 1, ADD>(a + r, lda, b, ldb, k, c + r, ldc);
}

// Eliminates 3 columns that wait for nothing any more: rows `first` to m, the diagonal block at row j. SIGNED: pivots of any
// sign s, l_jj = |d|^1/2; `by` gets the columns times s. Returns the column whose pivot is not positive (SIGNED: zero), or -1.
template <class T, bool SIGNED>
static int finish(T* panel, T* by, int64_t ld, int64_t j, int64_t first, int64_t m, T* sign) {
    T *x = panel + j * ld, *y = x + ld, *z = y + ld, l[3][3], s[3] = {1, 1, 1}, over[3];
    for (int c = 0; c < 3; ++c) {
        for (int r = c; r < 3; ++r) {
            T v = x[c * ld + j + r];
            for (int p = 0; p < c; ++p) v -= l[r][p] * s[p] * l[c][p];
            if (r > c) {
                l[r][c] = v * over[c];
                continue;
            }
            if (SIGNED && v < 0) s[c] = -1, v = -v;
            if (!(v > 0)) return c;
            l[c][c] = std::sqrt(v);
            over[c] = s[c] / l[c][c];
        }
    }
    const T yx = l[1][0] * s[0], zx = l[2][0] * s[0], zy = l[2][1] * s[1];
    for (int64_t i = first; i < m; i += V<T>) {
        lanes<T>&u = *(lanes<T>*)(x + i), &v = *(lanes<T>*)(y + i), &w = *(lanes<T>*)(z + i);
        u = u * over[0];
        v = (v - u * yx) * over[1];
        w = (w - u * zx - v * zy) * over[2];
    }
    for (int c = 0; c < 3; ++c)
        for (int r = c; r < 3; ++r) x[c * ld + j + r] = l[r][c];
    if (SIGNED)
        for (int c = 0; c < 3; ++c) {
            sign[j + c] = s[c];
            for (int64_t i = first; i < m; ++i) by[(j + c) * ld + i] = s[c] * x[c * ld + i];
        }
    return -1;
}

// Eliminates the k own columns of a panel of m rows. Returns the column whose pivot failed, or -1.
template <class T, bool SIGNED>
static int64_t eliminate(T* panel, T* by, int64_t ld, int64_t m, int64_t k, T* sign, const Library& library) {
    if (!SIGNED && k > NARROW) {
        int64_t rows = m - k, info = 0;
        T one = 1;
        library.potrf("L", &k, panel, &ld, &info);
        if (info) return info - 1;
        if (rows) library.trsm("R", "L", "T", "N", &rows, &k, &one, panel, &ld, panel + k, &ld);
        return -1;
    }
    for (int64_t j = 0; j < k; j += 3) {
        const int64_t first = j / V<T> * V<T>;
        if (j) strip<T, true>(m - first, panel + first, ld, by + j, ld, j, panel + j * ld + first, ld);
        if (int c = finish<T, SIGNED>(panel, by, ld, j, first, m, sign); c >= 0) return j + c;
    }
    return -1;
}

// update = -below by^T, its lower triangle; below (n, k).
template <class T, bool SIGNED>
static void square(T* update, int64_t ldu, T* below, const T* by, int64_t ld, int64_t n, int64_t k, const Library& library) {
    if (n == 0) return;
    if (!SIGNED && (k > NARROW || n * k * (int64_t)sizeof(T) > CACHED)) {
        T less = -1, none = 0;
        library.syrk("L", "N", &n, &k, &less, below, &ld, &none, update, &ldu);
        return;
    }
    for (int64_t j = 0; j < n; j += 3) {
        const int64_t first = j / V<T> * V<T>;
        strip<T, false>(n - first, below + first, ld, by + j, ld, k, update + j * ldu + first, ldu);
    }
}

template <class T> static inline void add(T* to, int64_t ldt, const T* from, int64_t ldf, int64_t rows) {
    for (int c = 0; c < 3; ++c, to += ldt, from += ldf) {
        int64_t i = 0;
        for (; i + V<T> <= rows; i += V<T>) *(lanes<T>*)(to + i) += *(const lanes<T>*)(from + i);
        for (; i < rows; ++i) to[i] += from[i];
    }
}

// Adds a child's update matrix where its rows are among those of the front: to its panel, or PANEL false: to its update.
template <class T, bool PANEL>
static void extend_add(const int32_t* run, const int32_t* end, const T* from, int64_t ldf, T* to, int64_t ldt, int64_t own) {
    int64_t column = 0;  // first node of the run in the child
    for (const int32_t* q = run; q < end; column += q[1], q += 2) {
        const int64_t split = std::clamp<int64_t>(own - q[0], 0, q[1]);  // of the run's columns, those in the panel
        for (int64_t i = PANEL ? 0 : split; i < (PANEL ? split : q[1]); ++i) {
            const T* f = from + 3 * ((column + i) * ldf + column + i);
            const int64_t shift = PANEL ? 0 : own;
            T* t = to + 3 * (q[0] + i - shift) * ldt - 3 * shift;
            add(t + 3 * (q[0] + i), ldt, f, ldf, 3 * (q[1] - i));
            f += 3 * (q[1] - i);
            for (const int32_t* r = q + 2; r < end; f += 3 * r[1], r += 2) add(t + 3 * r[0], ldt, f, ldf, 3 * r[1]);
        }
        if (PANEL && split < q[1]) return;
    }
}

// Puts the entries of A into a panel of zeros, times `scale`.
template <class T>
static void enter(const Fronts& f, int64_t first, int64_t own, const double* values, double scale, T* panel, int64_t ld) {
    for (int64_t c = 0; c < own; ++c)
        for (int64_t e = f.entry_start[first + c]; e < f.entry_start[first + c + 1]; ++e) {
            const double* a = values + 9 * (int64_t)f.entry_block[e];
            T* to = panel + 3 * c * ld + 3 * f.entry_row[e];
            for (int j = 0; j < 3; ++j)
                for (int i = 0; i < 3; ++i) to[j * ld + i] = (T)(scale * a[3 * i + j]);
        }
}

// Writes the columns of L, each from its diagonal down, times `scale`. Returns the first whose values are out of range, or -1.
template <class T, class O>
static int64_t put(const T* panel, int64_t ld, int64_t m, int64_t k, T scale, O*& out) {
    const O most = sizeof(O) == 4 ? (O)FLT_MAX : (O)DBL_MAX, tiny = sizeof(O) == 4 ? (O)FLT_MIN : (O)DBL_MIN;
    for (int64_t c = 0; c < k; ++c) {
        const T* from = panel + c * ld + c;
        int bad = !((O)(from[0] * scale) >= tiny);
        for (int64_t i = 0; i < m - c; ++i) {
            const O v = (O)(from[i] * scale);
            bad |= !(std::fabs(v) <= most);
            out[i] = v;
        }
        if (bad) return c;
        out += m - c;
    }
    return -1;
}

static double largest(const double* block) { return std::max({std::fabs(block[0]), std::fabs(block[4]), std::fabs(block[8])}); }

// Returns 2^e with e even, so that the diagonal of A over it is at most 4: float32 then has room for its updates.
static double power(const Fronts& f, const double* values) {
    double most = 0;
    for (int64_t c = 0; c < f.nodes; ++c) most = std::max(most, largest(values + 9 * (int64_t)f.entry_block[f.entry_start[c]]));
    int e = 0;
    if (most > 0) std::frexp(most, &e);
    return std::ldexp(1.0, e / 2 * 2);
}

// Plans the stacks for columns that begin at multiples of a vector; `most`: entries of the largest panel and of both stacks.
static void plan(Multifrontal& w, int64_t to, int64_t most[3]) {
    const Fronts& f = w.fronts;
    int64_t top[2] = {0, 0};
    most[0] = most[1] = most[2] = 0;
    w.waiting[0].clear(), w.waiting[1].clear();
    for (int64_t s = 0; s < f.count; ++s) {
        const int mine = w.side[s], theirs = 1 - mine;
        const int64_t n = 3 * (int64_t)(f.height[s] - f.own[s]);
        most[0] = std::max(most[0], padded(3 * (int64_t)f.height[s], to) * 3 * f.own[s]);
        for (int c = 0; c < w.children[s]; ++c) {
            top[theirs] = w.at[w.waiting[theirs].back()];
            w.waiting[theirs].pop_back();
        }
        w.at[s] = top[mine];
        top[mine] += padded(n, to) * n;
        most[1 + mine] = std::max(most[1 + mine], top[mine]);
        w.waiting[mine].push_back((int32_t)s);
    }
}

template <class T, class O, bool SIGNED>
static Result factorize(Multifrontal& w, Work<T>& memory, const double* values, O* out, const Library& library) {
    const Fronts& f = w.fronts;
    Result result = {MADE, -1, 0, INFINITY};
    int64_t most[3];
    plan(w, V<T>, most);
    T *panel = memory.panel.of(most[0]), *by = SIGNED ? memory.scaled.of(most[0]) : panel;
    T* stack[2] = {memory.stack[0].of(most[1]), memory.stack[1].of(most[2])};
    memory.sign.assign(SIGNED ? 3 * f.nodes : 0, 1);
    if (SIGNED) w.growth.assign(3 * f.nodes, 0);
    const double scale = sizeof(T) == 4 ? power(f, values) : 1.0;
    w.waiting[0].clear(), w.waiting[1].clear();
    int64_t first = 0;  // own column, in nodes
    for (int64_t s = 0; s < f.count; first += f.own[s++]) {
        const int mine = w.side[s], theirs = 1 - mine;
        const int64_t k = 3 * f.own[s], m = 3 * f.height[s], n = m - k, ld = padded(m, V<T>), ldu = padded(n, V<T>);
        T* update = stack[mine] + w.at[s];
        std::vector<int32_t>& children = w.waiting[theirs];
        const auto child = [&](int c) { return children[children.size() - 1 - c]; };
        std::memset((void*)panel, 0, sizeof(T) * ld * k);
        enter(f, first, f.own[s], values, 1 / scale, panel, ld);
        for (int c = 0; c < w.children[s]; ++c) {
            const int32_t q = child(c), rows = 3 * (f.height[q] - f.own[q]);
            extend_add<T, true>(f.run + 2 * f.run_start[q], f.run + 2 * f.run_start[q + 1], stack[theirs] + w.at[q],
                                padded(rows, V<T>), panel, ld, f.own[s]);
        }
        T* sign = SIGNED ? memory.sign.data() + 3 * first : nullptr;
        if (int64_t c = eliminate<T, SIGNED>(panel, by, ld, m, k, sign, library); c >= 0) {
            result.outcome = PIVOT, result.column = 3 * first + c;
            return result;
        }
        for (int64_t c = 0; c < k; ++c) {
            const double l = panel[c * ld + c], norm = largest(values + 9 * (int64_t)f.entry_block[f.entry_start[first + c / 3]]);
            result.least = std::min(result.least, l * l * scale / norm);
            if (SIGNED) {
                result.negative += sign[c] < 0;
                const int32_t* rows = f.rows + f.row_start[s];
                for (int64_t i = c; i < m; ++i) w.growth[rows[i]] += (double)panel[c * ld + i] * panel[c * ld + i];
            }
        }
        square<T, SIGNED>(update, ldu, panel + k, by + k, ld, n, k, library);
        for (int c = 0; c < w.children[s]; ++c) {
            const int32_t q = child(c), rows = 3 * (f.height[q] - f.own[q]);
            extend_add<T, false>(f.run + 2 * f.run_start[q], f.run + 2 * f.run_start[q + 1], stack[theirs] + w.at[q],
                                 padded(rows, V<T>), update, ldu, f.own[s]);
        }
        children.resize(children.size() - w.children[s]);
        w.waiting[mine].push_back((int32_t)s);
        if (int64_t c = put(panel, ld, m, k, (T)std::sqrt(scale), out); c >= 0) {
            result.outcome = RANGE, result.column = 3 * first + c;
            return result;
        }
    }
    return result;
}

extern "C" {

// Returns null without memory.
Multifrontal* mf_new(const Fronts* fronts) {
    try {
        auto w = std::make_unique<Multifrontal>();
        const Fronts& f = w->fronts = *fronts;
        w->at.assign(f.count, 0);
        w->side.assign(f.count, 0);
        w->children.assign(f.count, 0);
        for (int64_t s = f.count - 1; s >= 0; --s)
            if (f.parent[s] >= 0) {
                w->side[s] = 1 - w->side[f.parent[s]];
                ++w->children[f.parent[s]];
            }
        return w.release();
    } catch (const std::bad_alloc&) {
        return nullptr;
    }
}

void mf_delete(Multifrontal* w) { delete w; }

// Factorizes A of block values (blocks, 3, 3). single: arithmetic in float32; narrow: L in float32, else in float64.
Result mf_factorize(Multifrontal* w, const double* values, int64_t blocks, int32_t single, int32_t narrow, void* out,
                    const Library* library) {
    int bad = 0;
    for (int64_t i = 0; i < 9 * blocks; ++i) bad |= !(std::fabs(values[i]) <= DBL_MAX);
    if (bad) return {NOT_FINITE, -1, 0, 0};
    try {
        if (single) return factorize<float, float, false>(*w, w->narrow, values, (float*)out, *library);
        if (narrow) return factorize<double, float, false>(*w, w->wide, values, (float*)out, *library);
        return factorize<double, double, false>(*w, w->wide, values, (double*)out, *library);
    } catch (const std::bad_alloc&) {
        return {MEMORY, -1, 0, 0};
    }
}

// Factorizes matrices as `mf_factorize` does one: in float32 first where L is `narrow`, and in float64 where that has no factor or
// its smallest pivot is at most `rough`. Values of L of one follow those of the one before, `nonzeros` each; least[i]: smallest
// pivot (Result), -1 where there is no factor.
void mf_factorize_many(Multifrontal* w, int64_t count, const double* const* values, int64_t blocks, int32_t narrow, double rough,
                       char* out, int64_t nonzeros, const Library* single, const Library* wide, double* least) {
    const int64_t step = nonzeros * (narrow ? sizeof(float) : sizeof(double));
    for (int64_t i = 0; i < count; ++i, out += step) {
        Result made = {PIVOT, -1, 0, 0};
        if (narrow) made = mf_factorize(w, values[i], blocks, 1, 1, out, single);
        if (made.outcome != MADE || !(made.least > rough)) made = mf_factorize(w, values[i], blocks, 0, narrow, out, wide);
        least[i] = made.outcome == MADE ? made.least : -1;
    }
}

// Writes the values of L |D|^1/2 of A = L D L^T in float64, or float32 if `narrow`; growth (n,): diagonal of L |D| L^T.
Result mf_signed(Multifrontal* w, const double* values, int32_t narrow, void* out, double* growth, const Library* library) {
    try {
        const Result result = narrow ? factorize<double, float, true>(*w, w->wide, values, (float*)out, *library)
                                     : factorize<double, double, true>(*w, w->wide, values, (double*)out, *library);
        std::copy(w->growth.begin(), w->growth.end(), growth);
        return result;
    } catch (const std::bad_alloc&) {
        return {MEMORY, -1, 0, 0};
    }
}
}
