# SPDX-License-Identifier: MIT
"""What the rest of the server uses of a place where steps run, the processor or a GPU.

A `Backend` compiles kernel texts and binds host arrays to them.
"""

from typing import Any, Protocol

from numpy.typing import NDArray


class Launch(Protocol):
    """One kernel with its arguments."""

    name: str  # text.kernel
    items: int

    @property
    def domain(self) -> str:
        """What its items are, as its text says: elements, nodes, blocks or another word."""
        ...

    def fetch(self, name: str) -> NDArray[Any]:
        """One of its arrays as kernels have left it."""
        ...

    def __call__(self) -> None:
        """Runs it once, outside of steps (set-up, energies, tests)."""
        ...


class Module(Protocol):
    """A compiled kernel text."""

    def bind(self, kernel: str, n: int, **arguments: Any) -> Launch:
        """Launch of `kernel` over n items with arrays and numbers by the names of its argument struct.

        Raises TypeError where an argument does not fit the text.
        """
        ...


class Backend(Protocol):
    """A device as a place for kernels to run. Arrays are named by the host's; a GPU has a twin of each."""

    @property
    def name(self) -> str:
        """The word for it: cpu or gpu."""
        ...

    def module(self, path: str) -> Module:
        """A kernel text of this package (path: as of compiler.read_text), compiled once."""
        ...

    def build(self) -> str:
        """Digest of what a run depends on beside its scene: equal ones repeat it bit for bit."""
        ...

    def keep(self, *hosts: NDArray[Any], exact: bool = False) -> None:
        """Declares arrays that stay for the whole run. exact: in their type, whatever the precision of the kernels."""
        ...

    def fetch(self, host: NDArray[Any]) -> NDArray[Any]:
        """The array with what kernels have made of it."""
        ...
