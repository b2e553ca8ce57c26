// SPDX-License-Identifier: MIT
// Numbers that the loops and solvers of both devices, records and Python (backends/kinds.py) share.
#pragma once

// Preconditioners. CHOLESKY: any factor; SSOR: not on a GPU.
enum Kind { NONE = 0, JACOBI = 1, BLOCK_JACOBI = 2, CHOLESKY = 3, SSOR = 4 };

// How a solve ended, the last three: a step; CONTACT: not where its solves did, or without the law (status_in_contact).
// SolveStatus in protocol/messages.proto has the same numbers.
enum Status { CONVERGED = 0, MAX_ITERATIONS = 1, BUDGET = 2, BREAKDOWN_MATRIX = 3, BREAKDOWN_PRECONDITIONER = 4, NOT_FINITE = 5,
              MAX_LINEARIZATIONS = 6, RUNAWAY = 7, CONTACT = 8 };

constexpr int ENOUGH = 20;  // iterations allowed from which on half of them tell whether a factor is of use (pcg.h)
