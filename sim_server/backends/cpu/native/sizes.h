// SPDX-License-Identifier: MIT
// Sizes of structs that Python reads from these texts (declarations.py), as the compiler lays them out: compared when a library is
// loaded. `wf_sizes` returns an array of them with an empty one at its end.
#pragma once
#include <cstdint>

struct StructSize {
    const char* name;
    int64_t bytes;
};

#define SIZE(type) {#type, sizeof(type)}
