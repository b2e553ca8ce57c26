# SPDX-License-Identifier: MIT
"""Memory that the native loop of the CPU and Python share: the structs of native/loop.h and its headers."""

import ctypes as c

from sim_server.backends.declarations import Declarations

TEXT = Declarations("backends/cpu/native/loop.h")
RECORD = TEXT.dtype("Record")  # one body, one step: native/ring_buffers.h
CHANGE = TEXT.dtype("Change")  # of a diagonal entry: native/woodbury.h
BALANCE = TEXT.dtype("Balance")  # kernels/energy_balance.cuh


@TEXT.struct
class Rings(c.Structure):
    """Records, frames, pace, stop and pause: the same for both devices."""


@TEXT.struct
class Pattern(c.Structure):
    """Supernodal pattern of a factor."""


@TEXT.struct
class Factor(c.Structure):
    """Values of a factor and its pattern."""


@TEXT.struct
class SolveSettings(c.Structure):
    """Settings of a solve."""


@TEXT.struct
class Binding(c.Structure):
    """Arguments of a launch."""


@TEXT.struct
class Launch(c.Structure):
    """A kernel and its arguments."""


@TEXT.struct
class Correction(c.Structure):
    """Low-rank correction of a factor."""


@TEXT.struct
class Body(c.Structure):
    """A body: its nodes, settings, mailboxes and factor."""


@TEXT.struct
class Search(c.Structure):
    """State of Newton-Raphson of a body."""


@TEXT.struct
class Limits(c.Structure):
    """Limits of Newton-Raphson."""


@TEXT.struct
class Newton(c.Structure):
    """Input and memory of Newton-Raphson."""


@TEXT.struct
class Elastic(c.Structure):
    """Energies of the elements of an effect."""


@TEXT.struct
class Energies(c.Structure):
    """Input and memory of the energy balance."""


@TEXT.struct
class Loop(c.Structure):
    """All that the loop works with."""

    _anonymous_ = ("rings",)
