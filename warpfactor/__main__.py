# SPDX-License-Identifier: MIT
"""`python -m warpfactor`, as the console script warpfactor."""

from clients.demo.command import main

if __name__ == "__main__":
    main()
