# SPDX-License-Identifier: MIT
"""The meshes of an object of a log: their places in the file, and the few that were asked for last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from clients.log.frames import Mesh, mesh_of
from protocol import messages_pb2 as pb
from protocol.refused import Refused
from protocol.validate import checksum

KEPT = 4  # meshes of an object that are held at a time


class _Place(NamedTuple):
    """Where the message of a mesh is in the log."""

    offset: int
    number: int
    epoch: int  # of the mesh that it is, or is a part of
    nodes: int


class Meshes(Mapping[int, Mesh]):
    """Meshes by the epoch of their frames, in the order of the file; a mesh is made when it is asked for.

    read: returns the data of a message by offset and number
    """

    def __init__(self, read: Callable[[int, int], bytes]) -> None:
        self._read = read
        self._places: dict[int, _Place] = {}
        self._whole: dict[int, _Place] = {}  # by epoch: of a message that has all elements
        self._shapes: dict[int, tuple[int, ...]] = {}  # by epoch: checksums of nodes and elements
        self._made: OrderedDict[_Place, Mesh] = OrderedDict()  # the last used last

    def add(self, message: pb.Topology, offset: int, number: int) -> None:
        """Checks the mesh of a message and keeps its place.

        Raises Refused, also for other nodes or elements than those that came before in the same epoch.
        """
        epoch = message.header.epoch
        mesh = self._of(message)
        place = _Place(offset, number, epoch, message.nodes)
        if message.tets or not message.cut:
            shape = tuple(map(checksum, (message.rest, message.tets, message.skin_nodes)))
            if self._shapes.setdefault(epoch, shape) != shape:
                raise Refused(
                    f"Topology of {message.header.object!r}: epoch {epoch} again, with other nodes or elements; "
                    "allowed: those that it had before",
                    "epoch",
                )
            self._made.clear()  # moduli may be others
            self._whole[epoch] = place
        self._places[mesh.epoch] = place
        self._keep(place, mesh)

    def uncut(self, epoch: int) -> int:
        """Returns the epoch of the mesh without any cut. Raises KeyError for an epoch that is not there."""
        return self._places[epoch].epoch

    def nodes(self, epoch: int) -> int | None:
        """Returns the number of nodes in an epoch; None: it is not there."""
        return self._places[epoch].nodes if epoch in self._places else None

    def __getitem__(self, epoch: int) -> Mesh:
        return self._mesh(self._places[epoch])

    def __contains__(self, epoch: object) -> bool:
        return epoch in self._places

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def _mesh(self, place: _Place) -> Mesh:
        if place not in self._made:
            self._keep(place, self._of(pb.Topology.FromString(self._read(place.offset, place.number))))
        self._made.move_to_end(place)
        return self._made[place]

    def _of(self, message: pb.Topology) -> Mesh:
        whole = self._whole.get(message.header.epoch)
        part = message.cut and not message.tets
        return mesh_of(message, self._mesh(whole) if part and whole is not None else None)

    def _keep(self, place: _Place, mesh: Mesh) -> None:
        self._made[place] = mesh
        while len(self._made) > KEPT:
            self._made.popitem(last=False)
