# SPDX-License-Identifier: MIT
"""A process that grabs, moves the grab without rest, and never lets go. Arguments: endpoint, object."""

import sys
import time

from clients.client import Client
from protocol import messages_pb2 as pb


def main() -> None:
    endpoint, name = sys.argv[1:]
    with Client(connect=[endpoint]) as client:
        held = client.grab(name, at=(0.5, 0.5, 4), stiffness=1e4, max_force=2e3)
        print(client.id, flush=True)
        for number in range(600_000):  # an end, should nobody kill it
            target = pb.Vector(x=0.5 + 0.1 * (number % 7), y=1.0, z=4)
            client.send("move", pb.Interaction(object=name, id=held.interaction.id, target=target))
            time.sleep(1e-3)


if __name__ == "__main__":
    main()
