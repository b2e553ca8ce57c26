# SPDX-License-Identifier: MIT
"""A process that subscribes to everything at an endpoint, says so and is stopped by whoever started it."""

import sys
import time

import zenoh

from protocol.network.session import open_session


def main() -> None:
    with open_session("client", connect=[sys.argv[1]], shared_memory=False) as session:
        subscriber = session.zenoh.declare_subscriber("**", zenoh.handlers.RingChannel(1))
        print("listens", flush=True)
        time.sleep(1000)
        subscriber.undeclare()


if __name__ == "__main__":
    main()
