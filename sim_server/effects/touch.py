# SPDX-License-Identifier: MIT
"""Remote touch: pushes and grabs that clients send while the simulation runs.

A push is a force F [N] on the nodes within a radius of a point, for a while. A grab ties such nodes to a target point
by springs of stiffness k [N/m] in total, f = k (target - x), with a bounded force: once |f| would pass the limit, it
stays at the limit. The spring enters the system matrix (h^2 k on the diagonal), so a stiff grab is as stable as the
rest; a push is a plain force.

Clients are not trusted: a push beyond `max_force` is refused, a grab is bounded by it, and at most `max_interactions`
are alive at once on one object. An object that does not list this effect cannot be touched at all.

Usual ranges: max_force a few times the weight of the object (a 4000 kg beam weighs 4e4 N, a liver 15 N); a stiffness
of a grab near young times the size of the grabbed patch moves that patch without tearing it from its neighbours.
"""

from pydantic import Field

from sim_server.parameters import Parameters

SCOPE = "object"


class Params(Parameters):
    max_force: float = Field(default=1e4, gt=0, description="largest total force of one push or grab [N]")
    max_interactions: int = Field(default=16, ge=1, le=1024, description="pushes and grabs alive at once on the object")
