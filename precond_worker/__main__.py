# SPDX-License-Identifier: MIT
"""`python -m precond_worker` and the console script precond-worker."""

import os
import signal

# Until something is open that must be closed (cli.py): end at once, also in the middle of an import, without a
# traceback. What a parent lets its children ignore stays ignored.
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
signal.signal(signal.SIGTERM, lambda *_: os._exit(0))

from precond_worker.cli import main  # noqa: E402

if __name__ == "__main__":
    main()
