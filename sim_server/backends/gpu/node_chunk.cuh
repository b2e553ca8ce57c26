// SPDX-License-Identifier: MIT
// Nodes of a body that one thread block sums over.
#pragma once

struct NodeChunk {
    int body, begin, end;  // nodes
    int first, chunks;     // of the body
};
