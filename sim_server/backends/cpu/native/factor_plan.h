// SPDX-License-Identifier: MIT
// How the triangular solves of a factor are shared out between threads. It depends on the pattern alone, so it is made once for each,
// beside the steps.
//
// Supernodes form a tree: the rows of each below its own columns are among the rows of its parent. Subtrees of at most 1 / TASKS of the
// work are tasks, each done by one thread. What is above them, the top, is cut into panels of at most PANEL columns, and the rows
// below the columns of a panel into chunks of CHUNK rows, which are done side by side. Each task and each panel adds what it does to rows
// of its ancestors into a vector of its own over the rows of its parent, who adds up the vectors of its children in their order. None of
// this depends on the number of threads, so results do not, either; only who does what does.
// (Subtrees to processors: George, Liu and Ng, Communication results for parallel sparse Cholesky factorization on a hypercube, 1989.)
#pragma once
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <vector>

#include "supernodal.h"

constexpr int TASKS = 128, PANEL = 128, CHUNK = 256;
constexpr int64_t LEAST_TASK = 4096;  // values of L, whose time is about that of handing over a vector
constexpr int ROW_WORK = 4;           // of a row of a supernode, in values of L

struct alignas(64) Counter {
    std::atomic<uint64_t> count{0};
};

struct FactorPlan {
    struct Task {                  // a subtree, or several with the same parent
        int first, last;           // supernodes
        int parent;                // panel, -1: none
        int64_t sums, size;        // its vector over the parent's rows
    };
    struct Panel {
        int supernode, from, columns;  // columns of the supernode [from, from + columns)
        int parent;                // panel, -1: none
        int level;                 // panels below the root
        int64_t sums;              // its vector over the parent's rows, -1: none
        bool inside;               // the parent has the columns that follow in the supernode: rows in the same order
        int first_child, children; // of `child`
        int chunks, chunk;         // number, and the first
        int64_t arrivals = 0;      // tasks and chunks that add to its rows
    };
    struct Chunk {
        int panel, first, last;    // rows of the supernode
    };

    const Pattern& p;
    const int threads;             // that work is shared out to
    std::vector<int32_t> target;   // (rows,) where the forward sweep puts a row: into y, or into a vector over the parent's rows
    std::vector<Task> task;
    std::vector<Panel> panel;
    std::vector<Chunk> chunk;
    std::vector<int64_t> child;    // vectors over the rows of a panel
    std::vector<int> task_of;                // (threads + 1,) tasks of each thread
    std::vector<int> solve, solve_of;        // panels by level and thread; (levels * threads + 1,)
    std::vector<int> share_of;               // chunks by level and thread, likewise; chunks are numbered in this order
    int levels = 0, highest = 0;             // rows of the highest supernode
    // What sweeps work with. Entries of `room`: y, then all vectors, then CHUNK or the highest supernode's rows for each thread.
    std::unique_ptr<double[]> room, partial, product;  // likewise: (chunks, PANEL); (tasks + panels,)
    std::unique_ptr<Counter[]> arrived, solved, returned, known;  // (panels,)
    int64_t scratch = 0, entries = 0;
    uint64_t sweeps = 0;
    int bytes = 0;                 // of an entry of `room` as it was used last

    FactorPlan(const Pattern& pattern, int threads) : p(pattern), threads(threads) {}

    // False if the supernodes are no such tree, as those of incomplete factors are not.
    bool make() {
        if (!find_tree()) return false;
        choose_tasks();
        cut_top();
        join();
        share_out();
        reserve();
        return true;
    }
    int height(int s) const { return (int)(p.row_start[s + 1] - p.row_start[s]); }
    int width(int s) const { return p.super_start[s + 1] - p.super_start[s]; }

private:
    std::vector<int> parent, first_descendant, panel_of;  // of supernodes; first panel, -1: in a task
    std::vector<int64_t> below;                            // work of each subtree
    std::vector<int> at;                                   // place of a row among those of a supernode

    int64_t work_of(int s) const {
        const int64_t w = width(s), h = height(s);
        return w * h - w * (w - 1) / 2 + ROW_WORK * h;
    }

    bool find_tree() {
        const int count = p.supernodes;
        std::vector<int> supernode(p.size), marked(p.size, -1), descendants(count, 1);
        for (int s = 0; s < count; ++s) std::fill(supernode.begin() + p.super_start[s], supernode.begin() + p.super_start[s + 1], s);
        parent.assign(count, -1);
        below.assign(count, 0);
        first_descendant.resize(count);
        for (int s = 0; s < count; ++s) first_descendant[s] = s;
        std::vector<std::vector<int>> children(count);
        for (int s = 0; s < count; ++s) {
            const int32_t *rows = p.rows + p.row_start[s], w = width(s), h = height(s);
            highest = std::max(highest, h);
            below[s] += work_of(s);
            for (int k = 0; k < h; ++k) marked[rows[k]] = s;
            for (int q : children[s])
                for (int k = width(q); k < height(q); ++k)
                    if (marked[p.rows[p.row_start[q] + k]] != s) return false;
            if (descendants[s] != s - first_descendant[s] + 1) return false;  // not in postorder
            if (w == h) continue;
            const int up = parent[s] = supernode[rows[w]];
            children[up].push_back(s);
            below[up] += below[s];
            descendants[up] += descendants[s];
            first_descendant[up] = std::min(first_descendant[up], first_descendant[s]);
        }
        return true;
    }

    void choose_tasks() {
        int64_t all = 0;
        for (int s = 0; s < p.supernodes; ++s) all += work_of(s);
        const int64_t most = std::max(all / TASKS, LEAST_TASK);
        panel_of.assign(p.supernodes, -1);
        for (int s = 0; s < p.supernodes; ++s) {
            if (below[s] > most) {
                panel_of[s] = 0;  // numbered later
                continue;
            }
            if (parent[s] >= 0 && below[parent[s]] <= most) continue;  // within a task
            const int begin = first_descendant[s];
            Task* last = task.empty() ? nullptr : &task.back();
            if (last && last->last == begin && last->parent == parent[s] && last->size + below[s] <= most) {
                last->last = s + 1;
                last->size += below[s];
            } else {
                task.push_back({begin, s + 1, parent[s], -1, below[s]});
            }
        }
    }

    void cut_top() {
        for (int s = 0; s < p.supernodes; ++s) {
            if (panel_of[s] < 0) continue;
            panel_of[s] = (int)panel.size();
            const int w = width(s), parts = (w + PANEL - 1) / PANEL;
            for (int k = 0; k < parts; ++k) {
                const int from = w * k / parts, to = w * (k + 1) / parts;
                const bool last = k == parts - 1;
                panel.push_back({s, from, to - from, last ? -1 : (int)panel.size() + 1, 0, -1, !last, 0, 0, 0, 0});
            }
        }
        for (Panel& b : panel)  // the parents of supernodes are numbered now
            if (!b.inside && parent[b.supernode] >= 0) b.parent = panel_of[parent[b.supernode]];
        for (int b = (int)panel.size(); b-- > 0;) {
            panel[b].level = panel[b].parent < 0 ? 0 : panel[panel[b].parent].level + 1;
            levels = std::max(levels, panel[b].level + 1);
        }
    }

    // Gives each task and panel its vector, and the rows their places in it.
    void join() {
        target.assign(p.rows, p.rows + p.row_start[p.supernodes]);
        at.assign(p.size, -1);
        scratch = p.size;
        std::vector<std::vector<int64_t>> vectors(panel.size());
        auto vector_over = [&](int b) {
            const int64_t begin = scratch, size = height(panel[b].supernode) - panel[b].from;
            scratch += (size + 15) / 16 * 16;
            vectors[b].push_back(begin);
            return begin;
        };
        auto place = [&](int s, int first, int64_t sums) {  // rows of s that come after its task
            for (int64_t k = p.row_start[s] + width(s); k < p.row_start[s + 1]; ++k)
                if (p.rows[k] >= first) target[k] = (int32_t)(sums + at[p.rows[k]]);
        };
        auto number_rows = [&](int s) {
            for (int k = 0; k < height(s); ++k) at[p.rows[p.row_start[s] + k]] = k;
        };
        for (Task& t : task) {
            t.size = 0;
            if (t.parent < 0) continue;
            const int up = t.parent;
            t.parent = panel_of[up];
            t.sums = vector_over(t.parent);
            t.size = height(up);
            number_rows(up);
            for (int s = t.first; s < t.last; ++s) place(s, p.super_start[t.last], t.sums);
        }
        for (Panel& b : panel) {
            if (b.parent < 0) continue;
            b.sums = vector_over(b.parent);
            if (b.inside) continue;
            number_rows(panel[b.parent].supernode);
            place(b.supernode, p.super_start[b.supernode + 1], b.sums);
        }
        for (size_t b = 0; b < panel.size(); ++b) {
            panel[b].first_child = (int)child.size();
            panel[b].children = (int)vectors[b].size();
            child.insert(child.end(), vectors[b].begin(), vectors[b].end());
        }
    }

    // Who does what: neighbours in the tree go to the same thread, level by level.
    void share_out() {
        std::vector<double> work;
        for (const Task& t : task) {
            work.push_back(0);
            for (int s = t.first; s < t.last; ++s) work.back() += work_of(s);
        }
        task_of = split(work);
        solve_of.assign(1, 0);
        share_of.assign(1, 0);
        for (int level = 0; level < levels; ++level) {
            std::vector<Chunk> here;
            std::vector<double> rows;
            std::vector<std::pair<int, int>> begins;  // panel, its first chunk here
            for (int b = 0; b < (int)panel.size(); ++b) {
                Panel& of = panel[b];
                if (of.level != level) continue;
                const int first = of.from + of.columns, h = height(of.supernode), parts = (h - first + CHUNK - 1) / CHUNK;
                begins.push_back({b, (int)here.size()});
                of.chunk = (int)(chunk.size() + here.size());
                of.chunks = parts;
                for (int k = 0; k < parts; ++k) {
                    here.push_back({b, first + (int)((int64_t)(h - first) * k / parts), first + (int)((int64_t)(h - first) * (k + 1) / parts)});
                    rows.push_back((double)(here.back().last - here.back().first) * of.columns);
                }
            }
            const std::vector<int> parts = split(rows);
            for (int t = 0; t < threads; ++t) {
                for (const auto& [b, first] : begins) {
                    const int mine = std::min(first, std::max((int)here.size() - 1, 0));
                    const bool is_mine = here.empty() ? t == 0 : parts[t] <= mine && mine < parts[t + 1];
                    if (is_mine) solve.push_back(b);
                }
                solve_of.push_back((int)solve.size());
                share_of.push_back((int)chunk.size() + parts[t + 1]);
            }
            chunk.insert(chunk.end(), here.begin(), here.end());
        }
        for (const Task& t : task)
            if (t.parent >= 0) ++panel[t.parent].arrivals;
        for (const Panel& b : panel)
            if (b.parent >= 0) panel[b.parent].arrivals += b.chunks;
    }
    // Bounds of runs of about equal work, one for each thread.
    std::vector<int> split(const std::vector<double>& work) const {
        double all = 0, done = 0;
        for (double w : work) all += w;
        std::vector<int> bounds(1, 0);
        int k = 0;
        for (int t = 1; t < threads; ++t) {
            while (k < (int)work.size() && done + work[k] / 2 < all * t / threads) done += work[k++];
            bounds.push_back(k);
        }
        bounds.push_back((int)work.size());
        return bounds;
    }

    void reserve() {
        entries = scratch + (int64_t)threads * own_room();
        room.reset(new double[entries]());
        partial.reset(new double[std::max<size_t>(chunk.size(), 1) * PANEL]());
        product.reset(new double[task.size() + panel.size()]());
        for (auto* counters : {&arrived, &solved, &returned, &known}) counters->reset(new Counter[panel.size()]);
    }

public:
    int64_t own_room() const { return (std::max(highest, CHUNK) + 63) / 64 * 64; }
};
