# SPDX-License-Identifier: MIT
"""Memory that the native loop of the CPU and Python share: the structs of native/loop.h and its headers."""

import ctypes as c

from sim_server.backends.declarations import Declarations

LOOP = Declarations("backends/cpu/native/loop.h")
RECORD = LOOP.dtype("Record")  # one body, one step: kernels/step_record.cuh
REACTION = LOOP.dtype("Reaction")  # of a body on a grab or on another body: kernels/reaction.h
REACTION_KINDS = LOOP.enumeration("ReactionKind")
CHANGE = LOOP.dtype("Change")  # of a diagonal entry: native/woodbury.h
KNOWN_CONTACT = LOOP.dtype("KnownContact")  # contacts of a node: native/woodbury.h
MAX_CORRECTED: int = LOOP.constant("MAX_CORRECTED")  # nodes of a Correction
WORK: int = LOOP.constant("WORK")  # doubles a node: native/pcg.h
STABLE_STEP = LOOP.dtype("StableStep")  # of a body: kernels/stable_step.cuh
BALANCE = LOOP.dtype("Balance")  # kernels/energy_balance.cuh


@LOOP.struct
class Rings(c.Structure):
    """Records, frames, pace, stop and pause: the same for both devices."""


@LOOP.struct
class Pattern(c.Structure):
    """Supernodal pattern of a factor."""


@LOOP.struct
class Factor(c.Structure):
    """Values of a factor and its pattern."""


@LOOP.struct
class SolveSettings(c.Structure):
    """Settings of a solve."""


@LOOP.struct
class Binding(c.Structure):
    """Arguments of a launch."""


@LOOP.struct
class Copy(c.Structure):
    """New contents of an array."""


@LOOP.struct
class Changes(c.Structure):
    """New contents of arrays, copied between the same two steps."""


@LOOP.struct
class Launch(c.Structure):
    """A kernel and its arguments."""


@LOOP.struct
class CutNodes(c.Structure):
    """Nodes of a body that may lose elements."""


@LOOP.struct
class KnownDiagonals(c.Structure):
    """Diagonals of earlier matrices of a body."""


@LOOP.struct
class Correction(c.Structure):
    """Low-rank correction of a factor."""


@LOOP.struct
class Body(c.Structure):
    """A body: its nodes, settings, mailboxes and factor."""


@LOOP.struct
class Search(c.Structure):
    """State of Newton-Raphson of a body."""


@LOOP.struct
class Limits(c.Structure):
    """Limits of Newton-Raphson."""


@LOOP.struct
class Newton(c.Structure):
    """Input and memory of Newton-Raphson."""


@LOOP.struct
class SolveResult(c.Structure):
    """What became of a solve."""


@LOOP.struct
class StageState(c.Structure):
    """State of a Rosenbrock-W step of a body."""


@LOOP.struct
class Stages(c.Structure):
    """Input and memory of the Rosenbrock-W step."""


@LOOP.struct
class EulerForm(c.Structure):
    """Input and memory of steps of backward Euler in scenes of other schemes."""


@LOOP.struct
class ObstacleTable(c.Structure):
    """Shapes and poses of obstacles: kernels/shapes.cuh."""


@LOOP.struct
class ContactForce(c.Structure):
    """Force of a row of contact: kernels/contact_law.cuh."""


@LOOP.struct
class RowState(c.Structure):
    """State of a row of contact in the step under way."""


@LOOP.struct
class PassChoice(c.Structure):
    """What is known of the preconditioners of a body in passes of contact."""


@LOOP.struct
class Box(c.Structure):
    """A box of a surface's tree."""


@LOOP.struct
class EdgeWings(c.Structure):
    """Triangles at an edge of a surface: kernels/edge_edge.cuh."""


@LOOP.struct
class ContactReport(c.Structure):
    """What became of the contacts of a body."""


@LOOP.struct
class Ties(c.Structure):
    """Attachments and springs."""


@LOOP.struct
class OwnTables(c.Structure):
    """What does not touch each other of a body."""


@LOOP.struct
class OwnReference(c.Structure):
    """Since when, and how far, a body has moved against itself."""


@LOOP.struct
class OwnContact(c.Structure):
    """Input and memory of the contact of bodies with themselves."""


@LOOP.struct
class Contact(c.Structure):
    """Input and memory of contact."""


@LOOP.struct
class SubstepState(c.Structure):
    """State of explicit substeps."""


@LOOP.struct
class CentralDifference(c.Structure):
    """Input and memory of explicit substeps."""


@LOOP.struct
class ShortSteps(c.Structure):
    """State of a body whose steps are made of short ones."""


@LOOP.struct
class Halving(c.Structure):
    """Input and memory of steps that are made again by short ones."""


@LOOP.struct
class Elastic(c.Structure):
    """Energies of the elements of an effect."""


@LOOP.struct
class Energies(c.Structure):
    """Input and memory of the energy balance."""


@LOOP.struct
class RankOne(c.Structure):
    """Parts of A of rank one beside its blocks."""


@LOOP.struct
class Loop(c.Structure):
    """All that the loop works with."""

    _anonymous_ = ("rings",)
