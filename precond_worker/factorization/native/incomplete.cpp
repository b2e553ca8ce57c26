// SPDX-License-Identifier: MIT
// Incomplete Cholesky factorization of a symmetric matrix of 3x3 blocks, left-looking, with a drop tolerance and a bound on
// the fill (Saad, Iterative Methods for Sparse Linear Systems, 2nd edition, section 10.8; the linked lists of columns are those
// of Jones and Plassmann 1995), and the factor of the SSOR preconditioner, which has the pattern of A.
//
// A block L_ij with |L_ij|_F <= tolerance sqrt(|A_ii|_F) is dropped: row i of L has the norm of A_ii^1/2, so that the dropped
// blocks depend neither on units nor on rotations of the nodes. Columns are in the order of protocol/factor.py; each node is a
// supernode.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

struct Lower {              // block columns of the lower triangle of P A P^T, the diagonal block first, rows ascending
    int32_t nodes, unused;
    const int32_t* start;   // (nodes + 1,)
    const int32_t* row;
    const int32_t* source;  // block of the values
};

struct Block { double a[9]; };  // row by row

struct SparseFactor {
    std::vector<int64_t> start;  // (nodes + 1,) into row and block; columns without their diagonal
    std::vector<int32_t> row;
    std::vector<Block> block, diagonal;  // L_ij; the lower triangles L_jj
    // scratch
    std::vector<Block> w;
    std::vector<int32_t> next, head, touched, stamp;
    std::vector<int64_t> at;
    std::vector<double> norm, weight;
};

static double squares(const double* a) {
    double s = 0;
    for (int k = 0; k < 9; ++k) s += a[k] * a[k];
    return s;
}

// C C^T = a (its lower triangle is read); false if a pivot is not above `least`.
static bool cholesky3(const double* a, double least, double* c) {
    for (int k = 0; k < 9; ++k) c[k] = 0;
    for (int j = 0; j < 3; ++j) {
        double d = a[4 * j];
        for (int k = 0; k < j; ++k) d -= c[3 * j + k] * c[3 * j + k];
        if (!(d > least)) return false;
        c[4 * j] = std::sqrt(d);
        for (int i = j + 1; i < 3; ++i) {
            double s = a[3 * i + j];
            for (int k = 0; k < j; ++k) s -= c[3 * i + k] * c[3 * j + k];
            c[3 * i + j] = s / c[4 * j];
        }
    }
    return true;
}

// w = w C^-T
static void divide(double* w, const double* c) {
    for (int i = 0; i < 9; i += 3) {
        w[i] /= c[0];
        w[i + 1] = (w[i + 1] - w[i] * c[3]) / c[4];
        w[i + 2] = (w[i + 2] - w[i] * c[6] - w[i + 1] * c[7]) / c[8];
    }
}

// w -= a b^T
static void subtract(double* w, const double* a, const double* b) {
    for (int i = 0; i < 9; i += 3)
        for (int j = 0; j < 3; ++j) w[i + j] -= a[i] * b[3 * j] + a[i + 1] * b[3 * j + 1] + a[i + 2] * b[3 * j + 2];
}

static void reset(const Lower& A, SparseFactor& L) {
    const size_t n = A.nodes;
    L.start.assign(1, 0);
    L.row.clear();
    L.block.clear();
    L.diagonal.resize(n);
    L.w.resize(n);
    L.next.assign(n, -1);
    L.head.assign(n, -1);
    L.stamp.assign(n, -1);
    L.at.assign(n, 0);
    L.norm.resize(n);
}

// Computes the norm of the largest block of each node, which in a positive definite matrix is its diagonal block.
static void measure(const Lower& A, const double* values, SparseFactor& L) {
    std::fill(L.norm.begin(), L.norm.end(), 0.0);
    for (int j = 0; j < A.nodes; ++j)
        for (int p = A.start[j]; p < A.start[j + 1]; ++p) {
            const double norm = std::sqrt(squares(values + 9 * (int64_t)A.source[p]));
            L.norm[j] = std::max(L.norm[j], norm);
            L.norm[A.row[p]] = std::max(L.norm[A.row[p]], norm);
        }
}

// Adds column k to the list of the column that it is subtracted from next.
static void link(SparseFactor& L, int k) {
    if (L.at[k] == L.start[k + 1]) return;
    int j = L.row[L.at[k]];
    L.next[k] = L.head[j];
    L.head[j] = k;
}

// Computes column j of A minus the eliminated columns: the diagonal block in L.w[j], the rows of the others in L.touched.
static void form(const Lower& A, const double* values, double shift, SparseFactor& L, int j) {
    L.touched.clear();
    for (int p = A.start[j]; p < A.start[j + 1]; ++p) {
        int i = A.row[p];
        std::memcpy(L.w[i].a, values + 9 * (int64_t)A.source[p], sizeof(Block));
        L.stamp[i] = j;
        if (i != j) L.touched.push_back(i);
    }
    for (int k = 0; k < 9; k += 4) L.w[j].a[k] += shift * L.norm[j] / std::sqrt(3.0);
    for (int k = L.head[j], after; k >= 0; k = after) {
        after = L.next[k];
        const double* by = L.block[L.at[k]].a;
        subtract(L.w[j].a, by, by);
        for (int64_t p = ++L.at[k]; p < L.start[k + 1]; ++p) {
            int i = L.row[p];
            if (L.stamp[i] != j) {
                L.stamp[i] = j;
                L.touched.push_back(i);
                std::memset(L.w[i].a, 0, sizeof(Block));
            }
            subtract(L.w[i].a, L.block[p].a, by);
        }
        link(L, k);
    }
}

// Divides the column by its diagonal block and keeps its largest blocks, at most `most`.
static void keep(SparseFactor& L, int j, double tolerance, int64_t most) {
    std::vector<int32_t>& rows = L.touched;
    L.weight.resize(L.norm.size());
    size_t kept = 0;
    for (int i : rows) {
        divide(L.w[i].a, L.diagonal[j].a);
        double weight = squares(L.w[i].a) / L.norm[i];
        if (!(weight > tolerance * tolerance)) continue;  // also zero
        L.weight[i] = weight;
        rows[kept++] = i;
    }
    rows.resize(kept);
    if ((int64_t)kept > most) {
        auto larger = [&](int a, int b) { return L.weight[a] != L.weight[b] ? L.weight[a] > L.weight[b] : a < b; };
        std::nth_element(rows.begin(), rows.begin() + most, rows.end(), larger);
        rows.resize(most);
    }
    std::sort(rows.begin(), rows.end());
    for (int i : rows) {
        L.row.push_back(i);
        L.block.push_back(L.w[i]);
    }
    L.start.push_back((int64_t)L.row.size());
}

extern "C" {

SparseFactor* ic_new() { return new SparseFactor; }
void ic_delete(SparseFactor* factor) { delete factor; }

// Factorizes A with shift |A_j| / sqrt(3) added to its diagonal, where |A_j| is the norm of the largest block of node j.
// fill: bound of the blocks of a column over the mean number in A, 0: none; least_pivot: of a node, over its norm.
// Returns -1, or the column where it broke down.
int32_t ic_factorize(const Lower* lower, const double* values, double shift, double tolerance, double fill, double least_pivot,
                     SparseFactor* factor) {
    const Lower& A = *lower;
    SparseFactor& L = *factor;
    reset(A, L);
    measure(A, values, L);
    const double column = (A.start[A.nodes] - A.nodes) / (double)A.nodes;
    const int64_t most = fill > 0 ? (int64_t)std::ceil(fill * column) : INT64_MAX;
    for (int j = 0; j < A.nodes; ++j) {
        form(A, values, shift, L, j);
        if (!(L.norm[j] > 0 && cholesky3(L.w[j].a, least_pivot * L.norm[j], L.diagonal[j].a))) return j;
        keep(L, j, tolerance, most);
        L.at[j] = L.start[j];
        link(L, j);
    }
    return -1;
}

// Makes F = sqrt(w / (2 - w)) (D / w + L) C^-T with C C^T = D / w and w = omega: F F^T is the P of SSOR.
int32_t ic_ssor(const Lower* lower, const double* values, double omega, SparseFactor* factor) {
    const Lower& A = *lower;
    SparseFactor& L = *factor;
    reset(A, L);
    const double scale = std::sqrt(omega / (2 - omega));
    for (int j = 0; j < A.nodes; ++j) {
        double d[9];
        const double* own = values + 9 * (int64_t)A.source[A.start[j]];
        for (int k = 0; k < 9; ++k) d[k] = own[k] / omega;
        if (!cholesky3(d, 0, L.diagonal[j].a)) return j;
        for (int p = A.start[j] + 1; p < A.start[j + 1]; ++p) {
            Block b;
            std::memcpy(b.a, values + 9 * (int64_t)A.source[p], sizeof(Block));
            divide(b.a, L.diagonal[j].a);
            for (double& x : b.a) x *= scale;
            L.row.push_back(A.row[p]);
            L.block.push_back(b);
        }
        for (double& x : L.diagonal[j].a) x *= scale;
        L.start.push_back((int64_t)L.row.size());
    }
    return -1;
}

int64_t ic_blocks(const SparseFactor* factor) { return (int64_t)factor->row.size(); }

// starts (nodes + 1,), rows (blocks,): columns without their diagonal.
void ic_pattern(const SparseFactor* factor, int64_t* starts, int32_t* rows) {
    std::copy(factor->start.begin(), factor->start.end(), starts);
    std::copy(factor->row.begin(), factor->row.end(), rows);
}

// Writes the values column by column, each from its diagonal down, the three columns of a node in turn.
void ic_values(const SparseFactor* factor, double* out) {
    const SparseFactor& L = *factor;
    for (size_t j = 0; j < L.diagonal.size(); ++j)
        for (int c = 0; c < 3; ++c) {
            for (int r = c; r < 3; ++r) *out++ = L.diagonal[j].a[3 * r + c];
            for (int64_t p = L.start[j]; p < L.start[j + 1]; ++p)
                for (int r = 0; r < 3; ++r) *out++ = L.block[p].a[3 * r + c];
        }
}
}
