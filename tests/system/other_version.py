# SPDX-License-Identifier: MIT
"""A worker of the next wire version; arguments as of precond-worker."""

import sys

import precond_worker.network.server_connection  # noqa: F401  everything that knows the version
from precond_worker.cli import main
from protocol.channels import PROTOCOL

for name, module in list(sys.modules.items()):
    if name.partition(".")[0] in ("protocol", "precond_worker") and hasattr(module, "PROTOCOL"):
        module.PROTOCOL = PROTOCOL + 1  # type: ignore[attr-defined]
main()
