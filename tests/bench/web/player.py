# SPDX-License-Identifier: MIT
"""Stands in for a server: a waving sheet of any size, sent 30 times a second without being simulated."""

import threading
import time
from types import TracebackType
from typing import Self

import numpy as np
import zenoh
from google.protobuf.message import Message

from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL, everything, key
from protocol.network.session import open_session
from tests.ports import free_endpoint

RATE = 30.0  # frames a second, as a server sends them
NAME, SHEET = "sim", "sheet"
SIZE, HEIGHT, SPEED = 1.0, 0.1, 6.0  # m, m, 1/s: of the sheet and its waves


class Player:
    """Publishes a sheet of side x side vertices from entering to leaving its context."""

    def __init__(self, side: int) -> None:
        x, z = np.meshgrid(np.linspace(0, SIZE, side), np.linspace(0, SIZE, side), indexing="ij")
        self.rest = np.stack([x.ravel(), np.zeros(side * side), z.ravel()], axis=1)
        a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
        corners = [np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)]
        self._triangles = np.concatenate(corners).astype("<i4")
        self.endpoint = free_endpoint()
        self._stop = threading.Event()

    def __enter__(self) -> Self:
        self._session = open_session("server", listen=[self.endpoint], shared_memory=False)
        zenoh_session = self._session.zenoh
        self._token = zenoh_session.liveliness().declare_token(key("alive_server", NAME, incarnation="7"))
        self._queryable = zenoh_session.declare_queryable(everything(NAME), self._answer)
        self._thread = threading.Thread(target=self._play)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._session.close()

    def _play(self) -> None:
        begun = time.monotonic()
        for step in range(1 << 30):
            if self._stop.wait(max(0.0, begun + step / RATE - time.monotonic())):
                return
            x = self.rest.copy()
            x[:, 1] = HEIGHT * np.sin(10 * self.rest[:, 0] + SPEED * step / RATE)
            state = pb.State(header=_header(SHEET, step), step=step, time=step / RATE, nodes=len(x), x=x.tobytes())
            state.v = np.zeros_like(x).tobytes()
            self._session.zenoh.put(key("state", NAME, object=SHEET), state.SerializeToString())

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for name, message in self._messages().items():
                if str(query.key_expr) == key(name, NAME):
                    where = key(name, NAME, object=SHEET) if name == "topology" else key(name, NAME)
                    query.reply(where, message.SerializeToString())

    def _messages(self) -> dict[str, Message]:
        status = pb.Status(header=_header(), scene="sheet", state="running", dt=1 / RATE, device="cpu")
        topology = pb.Topology(
            header=_header(SHEET), nodes=len(self.rest), rest=self.rest.tobytes(), triangles=self._triangles.tobytes()
        )
        return {
            "status": status, "topology": topology,
            "scene": pb.Scene(header=_header(), name="sheet", dt=1 / RATE, objects=[SHEET], server=NAME),
            "command": pb.Reply(header=_header(), status=status),
        }  # fmt: skip


def _header(object: str = "", sequence: int = 0) -> pb.Header:
    return pb.Header(protocol=PROTOCOL, incarnation=7, object=object, epoch=1, sequence=sequence)
