# SPDX-License-Identifier: MIT
"""`sim-client identify`: finds parameters of a scene with which it moves as was measured."""
