// SPDX-License-Identifier: MIT
// Keeps a factor useful after elements were removed, in the solver of a GPU (pcg.cu): nodes without elements are set apart, with r = 0 into
// P and z = 0 out of it. A direct solve around the cut besides, as on a CPU (backends/cpu/native/cut_nodes.h), would be done by one thread
// block and take longer than the iterations that it saves.
#pragma once

// What BlockRows.place has beside the position of a node: 1 in the sign of one without elements.
constexpr int APART = (int)0x80000000u, PLACE = ~APART;
