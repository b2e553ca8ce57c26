# SPDX-License-Identifier: MIT
"""`python -m precond_worker` and the console script precond-worker."""

from protocol.process.early_signals import end_at_once

end_at_once(terminated=0)  # until something is open that must be closed (cli.py)

from precond_worker.cli import main  # noqa: E402

if __name__ == "__main__":
    main()
