# SPDX-License-Identifier: MIT
"""Tells what each effect of a scene asked for: modules, kernels, launches, memory, keys of the network, log channels.

A scene is built as for a run, and who asks is looked up where something is asked for (asker.py), so there is no list of
effects here that could go out of date. No step is made.
"""
