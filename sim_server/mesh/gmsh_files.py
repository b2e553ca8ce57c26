# SPDX-License-Identifier: MIT
"""What meshio (5.3) lacks for files of gmsh, added while it reads one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

Read = Callable[..., Any]
FEW, SPREAD = 10**7, 16  # numbers of nodes up to FEW, or SPREAD times as many as there are nodes, are read


@contextmanager
def gmsh_files() -> Iterator[None]:
    """While it is entered, meshio reads files of gmsh 4 in which only some entities have a physical group ("save all"),
    and raises ValueError where the number of a node is too large.

    meshio leaves entities without a group out of a list that must have all, and then refuses the file; here they have
    the group 0, which is none. It makes an array as long as the largest number, of gigabytes where that is damaged.
    """
    from meshio.gmsh import _gmsh22, _gmsh40, _gmsh41

    wrapped = {"_read_entities": _with_groups, "_read_nodes": _with_numbers_in_bounds}
    given = [(m, name, getattr(m, name)) for m in (_gmsh22, _gmsh40, _gmsh41) for name in wrapped if hasattr(m, name)]
    try:
        for module, name, read in given:
            setattr(module, name, wrapped[name](read))
        yield
    finally:
        for module, name, read in given:
            setattr(module, name, read)


def _with_groups(read: Read) -> Read:
    def entities(*arguments: Any) -> Any:
        found = read(*arguments)
        for tags in found[0] if len(found) == 2 else found:
            tags.update({entity: groups if len(groups) else [0] for entity, groups in tags.items()})
        return found

    return entities


def _with_numbers_in_bounds(read: Read) -> Read:
    def nodes(*arguments: Any) -> Any:
        found = read(*arguments)
        numbers = np.asarray(found[1])
        most = max(FEW, SPREAD * len(numbers))
        if len(numbers) and numbers.max() > most:
            raise ValueError(f"a node of {len(numbers)} has the number {numbers.max():.0f}, at most {most} are read")
        return found

    return nodes
