# SPDX-License-Identifier: MIT
"""Runs one of our programs with a limit of its resources: short_of.py RLIMIT_NAME VALUE PACKAGE ARGUMENTS…"""

import resource
import runpy
import sys

if __name__ == "__main__":
    limit = int(sys.argv[2])
    resource.setrlimit(getattr(resource, sys.argv[1]), (limit, limit))
    sys.argv = sys.argv[3:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
