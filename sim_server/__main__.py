# SPDX-License-Identifier: MIT
"""`python -m sim_server` and the console script sim-server."""

from sim_server.cli import main

if __name__ == "__main__":
    main()
