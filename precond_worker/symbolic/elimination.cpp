// SPDX-License-Identifier: MIT
// Elimination tree and columns of L of a block pattern (elimination.py), in time proportional to the entries of A and
// to the columns that begin a supernode, not to those of L. Liu, The role of elimination trees in sparse
// factorization, 1990; Davis, Direct Methods for Sparse Linear Systems, 2006, chapter 4.

#include <algorithm>
#include <cstdint>
#include <vector>

namespace {

using Rows = std::vector<int32_t>;

struct Graph {
    int64_t nodes;
    const int32_t* row_start;  // (nodes + 1,)
    const int32_t* columns;
    const int64_t* order;      // (nodes,): node eliminated k-th
    std::vector<int32_t> rank; // inverse of order

    // Calls f with the step of each neighbour of the node that step k eliminates.
    template <class F>
    void neighbours(int64_t k, F f) const {
        int64_t node = order[k];
        for (int32_t e = row_start[node]; e < row_start[node + 1]; e++) f(rank[columns[e]]);
    }
};

void elimination_tree(const Graph& graph, int64_t* parent) {
    std::vector<int64_t> ancestor(graph.nodes, -1);
    std::fill(parent, parent + graph.nodes, -1);
    for (int64_t k = 0; k < graph.nodes; k++)
        graph.neighbours(k, [&](int64_t i) {
            while (i < k) {  // from i to its root, compressing the path
                int64_t next = ancestor[i];
                ancestor[i] = k;
                if (next < 0) {
                    parent[i] = k;
                    return;
                }
                i = next;
            }
        });
}

// Children of all nodes as linked lists, ascending; the last list holds the roots.
struct Children {
    std::vector<int64_t> first, next;

    Children(const int64_t* parent, int64_t nodes) : first(nodes + 1, -1), next(nodes, -1) {
        for (int64_t k = nodes - 1; k >= 0; k--) {
            int64_t& head = first[parent[k] < 0 ? nodes : parent[k]];
            next[k] = head;
            head = k;
        }
    }
};

std::vector<int64_t> postorder(Children children, int64_t nodes) {  // a copy: its lists are consumed
    std::vector<int64_t> order, stack;
    order.reserve(nodes);
    for (int64_t root = children.first[nodes]; root >= 0; root = children.next[root]) {
        stack.push_back(root);
        while (!stack.empty()) {
            int64_t node = stack.back(), child = children.first[node];
            if (child < 0) {
                order.push_back(node);
                stack.pop_back();
            } else {
                children.first[node] = children.next[child];
                stack.push_back(child);
            }
        }
    }
    return order;
}

struct Columns {
    Rows rows;  // of the last columns of runs, one after another
};

}  // namespace

extern "C" {

// Fills parent (nodes,): -1 at a root; count (nodes,): entries of a column, its diagonal included; first, length
// (nodes,): where the rows below a column are, in steps of the elimination, unsorted; length -1: of a column that is
// the only child of the next one and has the same rows. Returns what eliminate_rows and eliminate_free take.
Columns* eliminate_columns(
    int64_t nodes, const int32_t* row_start, const int32_t* columns, const int64_t* order, int64_t* parent,
    int64_t* count, int64_t* first, int64_t* length, int64_t* total
) {
    Graph graph{nodes, row_start, columns, order, std::vector<int32_t>(nodes)};
    for (int64_t k = 0; k < nodes; k++) graph.rank[order[k]] = int32_t(k);
    elimination_tree(graph, parent);
    Children children(parent, nodes);
    Columns* made = new Columns;
    std::vector<Rows> open(nodes);          // rows of columns whose parent is not done; those up to a column itself count not
    std::vector<int64_t> mark(nodes, -1);   // the run that holds a row; runs are contiguous in a postorder
    int64_t run = -1;
    auto close = [&](int64_t k) {
        first[k] = int64_t(made->rows.size());
        for (int32_t row : open[k])
            if (row > k) made->rows.push_back(row);
        length[k] = int64_t(made->rows.size()) - first[k];
    };
    for (int64_t k : postorder(children, nodes)) {
        int64_t child = children.first[k];
        bool only = child >= 0 && children.next[child] < 0, more = !only;
        if (only) graph.neighbours(k, [&](int64_t row) { more = more || (row > k && mark[row] != run); });
        first[k] = 0;
        if (!more) {
            length[child] = -1;
            count[k] = count[child] - 1;
            open[k] = std::move(open[child]);
        } else {
            Rows& rows = open[k];
            int64_t largest = child;
            for (int64_t c = child; c >= 0; c = children.next[c]) {
                close(c);
                if (open[c].size() > open[largest].size()) largest = c;
            }
            run++;
            if (child >= 0) {
                rows = std::move(open[largest]);
                rows.erase(std::remove_if(rows.begin(), rows.end(), [&](int32_t row) { return row <= k; }), rows.end());
                for (int32_t row : rows) mark[row] = run;
            }
            auto add = [&](int64_t row) {
                if (row > k && mark[row] != run) {
                    mark[row] = run;
                    rows.push_back(int32_t(row));
                }
            };
            for (int64_t c = child; c >= 0; c = children.next[c]) {
                if (c == largest) continue;
                for (int32_t row : open[c]) add(row);
                Rows().swap(open[c]);
            }
            graph.neighbours(k, add);
            count[k] = int64_t(rows.size()) + 1;
        }
        if (parent[k] < 0) {
            close(k);
            Rows().swap(open[k]);
        }
    }
    *total = int64_t(made->rows.size());
    return made;
}

void eliminate_rows(const Columns* made, int32_t* rows) { std::copy(made->rows.begin(), made->rows.end(), rows); }

void eliminate_free(Columns* made) { delete made; }

}  // extern "C"
