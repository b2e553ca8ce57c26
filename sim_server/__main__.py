# SPDX-License-Identifier: MIT
"""`python -m sim_server` and the console script sim-server."""

from protocol.process.early_signals import end_at_once

end_at_once(terminated=0)  # until something is open that must be closed (cli.py)

from sim_server.cli import main  # noqa: E402

if __name__ == "__main__":
    main()
