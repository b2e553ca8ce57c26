// SPDX-License-Identifier: MIT
// Nodes of a body that a thread block sums over (energies.node_chunks).
#pragma once

struct NodeChunk {
    int body, begin, end;  // nodes
    int first, chunks;     // of the body
};
