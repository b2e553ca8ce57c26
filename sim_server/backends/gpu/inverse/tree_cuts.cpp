// SPDX-License-Identifier: MIT
// Partitions of an elimination tree, their predicted times, and the balance of their work over thread blocks: what
// tree_cuts.py, partition.py and load_balance.py compute, for hundreds of thresholds per topology.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <tuple>
#include <vector>

#ifdef __clang__  // the same roundings, and so the same plans, with and without fused multiply-add
#pragma clang fp contract(off)
#else
#pragma GCC optimize("fp-contract=off")
#endif

namespace {

// Measured on an H200. The ratio of latency to bandwidth decides, and it is similar on other large GPUs.
const double LATENCY = 3000, LATENCY_ALONE = 400;  // of a phase [ns]: of several blocks, of one block
const double MEMORY = 4400 / 132.0, CACHE = 7000 / 132.0, SHARED = 25000 / 132.0;  // bandwidths of one block [bytes/ns]
const double CACHED = 25e6;             // bytes that stay in the near half of the second-level cache
const double KEPT = 0.83, X_AREA = 0.7; // share of a block's shared memory: for matrices and vectors; for vectors at most
const double LOAD = 250, LOAD_ENTRY = 0.4;  // time of loading the vector of a part [ns]: constant, per entry
const double LARGE = 100e6, TILE = 35;  // bytes of matrices of which no cache keeps much; constant time of a tile of theirs [ns]
const double FLOPS = 10e3, USES = 3000; // of building the inverse: float32 operations per ns; applications that share its time
const int64_t COLUMNS = 32, ROWS = 8;   // of a chunk (partition.py)
const double CUT_GAIN = 1.1;            // matrices are cut anywhere only if whole ones take this many times as long
const int64_t MANY = 8;                 // matrices per block above which whole ones balance well enough

using Ints = std::vector<int64_t>;
using Reals = std::vector<double>;

int64_t padded(int64_t count, int64_t step) { return (count + step - 1) / step * step; }

// The largest integer not above x / y, exactly, of positive y.
int64_t floor_division(double x, double y) {
    double rest = std::fmod(x, y);
    if (rest < 0) rest += y;
    return int64_t(std::llround((x - rest) / y));
}

struct Cut {
    int64_t groups;
    Ints part, group, root, v, b;
};

// Sets part to the rank of its present value among all, and keep to where each first occurs.
Ints renumbered(Ints& part, int64_t values) {
    Ints first(values, -1), keep;
    for (size_t i = 0; i < part.size(); i++)
        if (first[part[i]] < 0) first[part[i]] = int64_t(i);
    Ints number(values, -1);
    for (int64_t value = 0; value < values; value++)
        if (first[value] >= 0) {
            number[value] = int64_t(keep.size());
            keep.push_back(first[value]);
        }
    for (int64_t& each : part) each = number[each];
    return keep;
}

// Trees of a few nodes share a part of one chunk's width.
Ints joined_parts(const Ints& v, const Ints& b) {
    Ints label(v.size());
    std::iota(label.begin(), label.end(), 0);
    int64_t room = 0, home = -1;
    for (size_t s = 0; s < v.size(); s++) {
        if (b[s] != 0 || v[s] > COLUMNS / 2) continue;
        if (v[s] > room) room = COLUMNS, home = int64_t(s);
        room -= v[s];
        label[s] = home;
    }
    return label;
}

Cut partition(
    int64_t supernodes, const int64_t* parent, const int64_t* width, const int64_t* height, const int64_t* size,
    const int64_t* thresholds, int64_t count
) {
    Cut cut{count + 1, Ints(supernodes), {}, {}, {}, {}};
    Ints level(supernodes);
    for (int64_t s = 0; s < supernodes; s++)
        level[s] = std::lower_bound(thresholds, thresholds + count, size[s]) - thresholds;
    std::iota(cut.part.begin(), cut.part.end(), 0);
    for (int64_t s = supernodes - 1; s >= 0; s--)
        if (parent[s] >= 0 && level[s] == level[parent[s]]) cut.part[s] = cut.part[parent[s]];
    Ints roots(cut.part);  // a part is named after its root
    std::sort(roots.begin(), roots.end());
    roots.erase(std::unique(roots.begin(), roots.end()), roots.end());
    renumbered(cut.part, supernodes);
    Ints v(roots.size()), b, group;
    for (int64_t s = 0; s < supernodes; s++) v[cut.part[s]] += width[s];
    for (int64_t r : roots) {
        b.push_back(height[r] - width[r]);
        group.push_back(b.back() == 0 ? count : level[r]);
    }
    Ints joined = joined_parts(v, b);
    Ints keep = renumbered(joined, int64_t(roots.size()));
    Ints total(keep.size());
    for (size_t p = 0; p < v.size(); p++) total[joined[p]] += v[p];
    Ints order(keep.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int64_t x, int64_t y) { return group[keep[x]] < group[keep[y]]; });
    Ints rank(order.size());
    for (size_t k = 0; k < order.size(); k++) {
        int64_t p = order[k];
        rank[p] = int64_t(k);
        cut.group.push_back(group[keep[p]]);
        cut.root.push_back(roots[keep[p]]);
        cut.v.push_back(total[p]);
        cut.b.push_back(b[keep[p]]);
    }
    for (int64_t& each : cut.part) each = rank[joined[each]];
    return cut;
}

// Of one phase, per matrix: number of tiles, time of one tile [ns], time of loading the vector [ns].
struct Work {
    Ints tiles;
    Reals tile, load;
};

double stored_bytes(const Cut& cut, int64_t planes) {
    double sum = 0;
    for (size_t p = 0; p < cut.v.size(); p++) {
        double v = double(padded(cut.v[p], COLUMNS)), b = double(padded(cut.b[p], COLUMNS));
        sum += v * v + 2 * v * b;
    }
    return sum * 2 * double(planes);
}

double bandwidth(const Cut& cut, int64_t planes) { return stored_bytes(cut, planes) < CACHED ? CACHE : MEMORY; }

Work phase_work(const Cut& cut, int64_t phase, int64_t planes, double rate) {
    int64_t group = std::min(phase, 2 * cut.groups - 2 - phase);
    bool forward = phase < cut.groups - 1, backward = phase >= cut.groups;
    double constant = stored_bytes(cut, planes) > LARGE ? TILE : 0;
    Work work;
    for (size_t p = 0; p < cut.v.size(); p++) {
        if (cut.group[p] != group) continue;
        int64_t columns = padded(cut.v[p], COLUMNS) + (backward ? padded(cut.b[p], COLUMNS) : 0);
        work.tiles.push_back(padded(forward ? cut.b[p] : cut.v[p], ROWS) / ROWS);
        work.tile.push_back(double(columns) * (2.0 * ROWS * double(planes)) / rate + constant);
        work.load.push_back(LOAD + LOAD_ENTRY * double(columns));
    }
    return work;
}

double latency(int64_t blocks) { return blocks == 1 ? LATENCY_ALONE : LATENCY; }

// Of building the inverse [ns], divided by the applications that share it.
double build_time(const Cut& cut) {
    double sum = 0;
    for (size_t p = 0; p < cut.v.size(); p++) {
        double v = double(cut.v[p]), b = double(cut.b[p]);
        sum += 2 / 3.0 * (v * v * v) + v * v * b;
    }
    return sum / FLOPS / USES;
}

double estimated(const Cut& cut, int64_t blocks, int64_t planes, int64_t shared) {
    double rate = bandwidth(cut, planes), kept = KEPT * double(shared), time = 0;
    for (int64_t phase = 0; phase < 2 * cut.groups - 1; phase++) {
        Work work = phase_work(cut, phase, planes, rate);
        if (work.tiles.empty()) continue;
        double all = 0, largest = 0, loads = 0, used = 0;
        for (size_t m = 0; m < work.tiles.size(); m++) {
            all += double(work.tiles[m]) * work.tile[m];
            largest = std::max(largest, work.tile[m]);
        }
        double busiest = std::max(all / double(blocks), largest);
        for (size_t m = 0; m < work.tiles.size(); m++) {  // share: blocks of each part
            double share = std::max(1.0, std::min(double(work.tiles[m]), double(work.tiles[m]) * work.tile[m] / busiest));
            loads += work.load[m] * share;
            used += std::ceil(share);
        }
        double bytes_kept = std::min(kept, busiest * rate);
        kept -= bytes_kept;
        time += bytes_kept / SHARED + (busiest - bytes_kept / rate) + loads / std::min(double(blocks), used) + latency(blocks);
    }
    return time + build_time(cut);
}

// About the largest number of entries that one block loads in a phase.
double largest_area(const Cut& cut, int64_t blocks) {
    Ints sum(cut.groups);
    for (size_t p = 0; p < cut.v.size(); p++)
        sum[cut.group[p]] += padded(cut.v[p], COLUMNS) + padded(cut.b[p], COLUMNS);
    return double(*std::max_element(sum.begin(), sum.end())) / double(blocks);
}

struct Piece {
    int64_t block, matrix, first, tiles;
};
using Pieces = std::vector<Piece>;

class Balance {
public:
    Balance(const Work& work, int64_t blocks) : work(work), blocks(blocks), cost(work.tiles.size()), by_cost(cost.size()) {
        for (size_t m = 0; m < cost.size(); m++) cost[m] = double(work.tiles[m]) * work.tile[m] + work.load[m];
        std::iota(by_cost.begin(), by_cost.end(), 0);
        std::stable_sort(by_cost.begin(), by_cost.end(), [&](int64_t x, int64_t y) { return cost[x] > cost[y]; });
    }

    Pieces pieces() {
        double whole_time = least(&Balance::whole);
        Pieces found;
        if (int64_t(cost.size()) > MANY * blocks || blocks == 1) {
            whole(whole_time, &found);
        } else {
            double cut_time = least(&Balance::cut);
            whole_time > CUT_GAIN * cut_time ? cut(cut_time, &found) : whole(whole_time, &found);
        }
        std::sort(found.begin(), found.end(), [](const Piece& x, const Piece& y) {
            return std::tie(x.block, x.matrix, x.first) < std::tie(y.block, y.matrix, y.first);
        });
        return found;
    }

private:
    const Work& work;
    int64_t blocks;
    Reals cost;
    Ints by_cost;  // the largest first

    // The least time [ns], to 1 %, for which an attempt finds a partition.
    double least(bool (Balance::*attempt)(double, Pieces*) const) const {
        double total = std::accumulate(cost.begin(), cost.end(), 0.0);
        double low = total / double(blocks), high = 1.001 * total;
        if ((this->*attempt)(low, nullptr)) return low;
        while (high > 1.01 * low) {
            double middle = std::sqrt(low * high);
            ((this->*attempt)(middle, nullptr) ? high : low) = middle;
        }
        return high;
    }

    // Gives matrices that take longer than `time` blocks of their own and packs the others; false if blocks run out.
    bool whole(double time, Pieces* found) const {
        int64_t used = 0, matrices = int64_t(cost.size());
        for (int64_t m = 0; m < matrices; m++) {
            if (!(cost[m] > time)) continue;
            double rest = time - work.load[m];
            int64_t each = rest < work.tile[m] ? 0 : floor_division(rest, work.tile[m]);  // tiles that a block has time for
            if (each < 1) return false;
            int64_t count = (work.tiles[m] + each - 1) / each, tiles = work.tiles[m];
            for (int64_t k = 0; found && k < count; k++) {
                int64_t first = k * tiles / count;
                found->push_back({used + k, m, first, (k + 1) * tiles / count - first});
            }
            used += count;
            if (used > blocks) return false;
        }
        size_t begin = 0;
        while (begin < by_cost.size() && cost[by_cost[begin]] > time) begin++;
        return packed(begin, time, used, found);
    }

    // Fills the blocks from `block` on with whole matrices, none above `time` (next fit, the largest first).
    bool packed(size_t begin, double time, int64_t block, Pieces* found) const {
        size_t count = by_cost.size() - begin, at = 0;
        Reals total(count + 1);
        for (size_t k = 0; k < count; k++) total[k + 1] = total[k] + cost[by_cost[begin + k]];
        for (; block < blocks && at < count; block++) {
            double most = total[at] + time * (1 + 1e-9);
            size_t fits = size_t(std::upper_bound(total.begin(), total.end(), most) - total.begin()) - 1;
            size_t end = std::max(at + 1, fits);
            for (; at < end; at++)
                if (found) found->push_back({block, by_cost[begin + at], 0, work.tiles[by_cost[begin + at]]});
        }
        return at == count;
    }

    // Fills one block after another with the tiles of one matrix after another; false if blocks run out.
    bool cut(double time, Pieces* found) const {
        int64_t block = 0;
        double left = time;
        for (size_t m = 0; m < cost.size(); m++) {
            int64_t rest = work.tiles[m];
            while (rest > 0) {
                double room = left - work.load[m];
                int64_t fits = room < work.tile[m] ? 0 : std::min(rest, floor_division(room, work.tile[m]));
                if (fits > 0) {
                    if (found) found->push_back({block, int64_t(m), work.tiles[m] - rest, fits});
                    rest -= fits;
                    left -= work.load[m] + double(fits) * work.tile[m];
                }
                if (rest > 0) {
                    if (left == time || block == blocks - 1) return false;
                    block++, left = time;
                }
            }
        }
        return true;
    }
};

double predicted(const Cut& cut, int64_t blocks, int64_t planes, int64_t shared) {
    double rate = bandwidth(cut, planes), time = 0;
    Reals kept(blocks, KEPT * double(shared)), stream(blocks), load(blocks);
    for (int64_t phase = 0; phase < 2 * cut.groups - 1; phase++) {
        Work work = phase_work(cut, phase, planes, rate);
        std::fill(stream.begin(), stream.end(), 0.0);
        std::fill(load.begin(), load.end(), 0.0);
        for (const Piece& piece : Balance(work, blocks).pieces()) {
            stream[piece.block] += double(piece.tiles) * work.tile[piece.matrix];
            load[piece.block] += work.load[piece.matrix];
        }
        double longest = 0;
        for (int64_t k = 0; k < blocks; k++) {
            double bytes_kept = std::min(kept[k], stream[k] * rate);
            kept[k] -= bytes_kept;
            longest = std::max(longest, bytes_kept / SHARED + stream[k] - bytes_kept / rate + load[k]);
        }
        time += longest + latency(blocks);
    }
    return time + build_time(cut);
}

}  // namespace

extern "C" {

// Writes the partition: part (supernodes,), group, root, v, b (at most as many). Returns the number of parts.
int64_t tree_partition(
    int64_t supernodes, const int64_t* parent, const int64_t* width, const int64_t* height, const int64_t* size,
    const int64_t* thresholds, int64_t count, int64_t* part, int64_t* group, int64_t* root, int64_t* v, int64_t* b
) {
    Cut cut = partition(supernodes, parent, width, height, size, thresholds, count);
    std::copy(cut.part.begin(), cut.part.end(), part);
    std::copy(cut.group.begin(), cut.group.end(), group);
    std::copy(cut.root.begin(), cut.root.end(), root);
    std::copy(cut.v.begin(), cut.v.end(), v);
    std::copy(cut.b.begin(), cut.b.end(), b);
    return int64_t(cut.v.size());
}

// Returns the time of one application [ns] with perfect balance, plus a share of the time of building; infinite if the
// tree has not so many groups, ten times as long if the vectors do not fit into shared memory.
double tree_estimate(
    int64_t supernodes, const int64_t* parent, const int64_t* width, const int64_t* height, const int64_t* size,
    const int64_t* thresholds, int64_t count, int64_t blocks, int64_t planes, int64_t shared
) {
    Cut cut = partition(supernodes, parent, width, height, size, thresholds, count);
    Ints there(cut.group);
    there.erase(std::unique(there.begin(), there.end()), there.end());  // sorted
    if (cut.groups > 1 && int64_t(there.size()) < cut.groups) return std::numeric_limits<double>::infinity();
    double time = estimated(cut, blocks, planes, shared);
    return 4 * largest_area(cut, blocks) > X_AREA * double(shared) ? time * 10 : time;
}

// Returns the same time with the actual partition of the work.
double tree_predict(
    int64_t supernodes, const int64_t* parent, const int64_t* width, const int64_t* height, const int64_t* size,
    const int64_t* thresholds, int64_t count, int64_t blocks, int64_t planes, int64_t shared
) {
    return predicted(partition(supernodes, parent, width, height, size, thresholds, count), blocks, planes, shared);
}

// Writes the work of a phase of a partition: tiles, tile, load. Returns the number of its matrices.
int64_t tree_phase(
    int64_t groups, int64_t parts, const int64_t* group, const int64_t* v, const int64_t* b, int64_t phase,
    int64_t planes, int64_t* tiles, double* tile, double* load
) {
    Cut cut{groups, {}, Ints(group, group + parts), {}, Ints(v, v + parts), Ints(b, b + parts)};
    Work work = phase_work(cut, phase, planes, bandwidth(cut, planes));
    std::copy(work.tiles.begin(), work.tiles.end(), tiles);
    std::copy(work.tile.begin(), work.tile.end(), tile);
    std::copy(work.load.begin(), work.load.end(), load);
    return int64_t(work.tiles.size());
}

// Assigns each tile to one of the blocks so that the longest time of a block is short. Writes pieces (k, 4): block,
// matrix, first, tiles, sorted; k is at most matrices + blocks. Returns k.
int64_t balance_tiles(
    int64_t matrices, const int64_t* tiles, const double* tile, const double* load, int64_t blocks, int64_t* pieces
) {
    Work work{Ints(tiles, tiles + matrices), Reals(tile, tile + matrices), Reals(load, load + matrices)};
    Pieces found = Balance(work, blocks).pieces();
    for (const Piece& piece : found) {
        *pieces++ = piece.block;
        *pieces++ = piece.matrix;
        *pieces++ = piece.first;
        *pieces++ = piece.tiles;
    }
    return int64_t(found.size());
}

}  // extern "C"
