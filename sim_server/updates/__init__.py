# SPDX-License-Identifier: MIT
"""When factors are made, of which matrix, and which of them are used. Start in driver.py.

A round: the policy (policies/) wants the matrices of some bodies (scheduler.py), the loop copies them (snapshots.py), a
source factorizes them (factor_source.py), the driver checks the factors (factor_check.py) and gives them to the loop;
the records of solves (solve_observer.py) tell what to do next (body_state.py, autotune/, useless_factors.py).
"""
