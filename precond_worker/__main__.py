# SPDX-License-Identifier: MIT
"""python -m precond_worker"""

from precond_worker.cli import main

if __name__ == "__main__":
    main()
