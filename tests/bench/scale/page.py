# SPDX-License-Identifier: MIT
"""The page: words, tables and the picture."""

from types import ModuleType
from typing import Any

from tests.bench.harness.report import Report, plots
from tests.bench.scale.measured import dragged, resting
from tests.bench.scale.simulate import MIX, Plan

BODIES = """Bodies at 50 steps a second, each with a factor, tolerance 1e-6. A core: one over what
a step takes ([a step on a CPU](cpu.md), async + warp). A GPU: one over what a step of one beam takes alone, and beam
steps of many in the same launches ([a step on a GPU](gpu.md)). By p99 nearly all steps end in time; by p50 half of
them do, and the loop catches up. Below 1 a body does not hold that rate."""
FACTORS = """A worker on a core: one over the processor time of a complete factor in float32
([complete factors](factors.md), supernodal); on a GPU as [measured there](gpu.md), for sizes whose factors it makes
itself. Bytes: values of L in float32, and the 3 x 3 blocks of the matrix in float64, both triangles, as they travel
where server and worker do not share memory. A link: 10 Gbit/s, which is assumed, not measured, as everything below
that a link limits."""
USERS = """Somebody who drags a body of his own at 50 steps a second, with factors of that age;
somebody who watches gets positions and velocities of all nodes in float32 at each step. Multiply by what a core, and
a byte that leaves, cost at yours. A body that rests costs the first part of the loop alone."""
CHOOSING = """Measured in this run: processor time of a worker of a pool, which hears each server
of it twice a second and looks twice a second; the least of several. Messages are read and checked one by one
(network/pool.py), a look is `PoolChoice.update`."""
RACKS = """All workers of one rack end at once, and as many come back 20 s later, as processes that
know nothing. *lost*: as above, of bodies in hands. *back*: from their return until it is at most 1.2 times what it
was before, over 2 s."""
LIMITS = """A limit is reached where *workers busy* or *busiest router* is near 100 %: the other
has room then. Links come first with these sizes and workers beside other hosts than their servers: a matrix and its
factor cross two routers. Faster links lift it (row above); so does a worker beside each server that shares memory
(`--workers 1`), which sends no byte over a link, with the pool for what that one cannot do, and `build = "worker"`,
which sends positions instead of matrices. Then processor time of workers comes next, which more of them, or GPUs for
the large bodies, lift. The third limit is what a worker hears: needs of all servers of its network, in proportion to
their number (table above); pools of a few hundred servers on networks of their own lift it, and lose little against
one pool (rows above). Of the servers' cores none is shared here."""


def words(plan: Plan) -> str:
    """How it was simulated."""
    mix = ", ".join(f"{100 * share:g} % of {tets} tets at {1 / dt:g} steps/s" for tets, dt, share in MIX)
    moving, still = dragged(), resting()
    return f"""{plan.servers} servers with a body and a core each ({mix}) and {plan.workers} workers of
a core each, in {plan.pools} pools and {plan.racks} racks. Each rack has a router that sends one array after another
at {plan.link * 8e-9:g} Gbit/s. In {100 * plan.touched:g} % of the servers, at a time, a body is in a hand, for
{plan.held:g} s on average. Times are those of the tables above; the worker's first job of a server since it took it
costs the analysis, too. Events are a matrix copied, sent, factorized, sent back and used from the next step on; a
server publishes its need and a worker looks at needs as in the product, by the very module (network/pool_choice.py of
precond_worker). {plan.seconds:g} s are simulated, the first {plan.warm:g} s do not count. Nothing but
the seed decides: figures of this part repeat to the digit.

Iterations above those with a fresh factor grow with its age: in a hand by {moving.slope:.3g} for each step of age,
{moving.most:.3g} at most, at rest by {still.slope:.3g}, {still.most:.3g} at most. That is read from [the rules
compared](scheduler.md): object dragged about with grabs corrected, and objects that tremble, without updates. Other
motion has other slopes; a factor that is never renewed costs iterations, never the answer ([faults](faults.md)).

*need*: as the product chooses. *fixed*: each worker has the same servers for ever. *random*: as many, drawn by lot
again every 5 s. *round robin*: all servers of the pool in turn, as before there was a choice. *age*: of factors of
bodies in hands, over time. *lost*: time of solving that a body in a hand loses in a second to the age of its factor,
the mean over bodies and time and its p99. *late*: of the time in hands, in which a step takes longer than the time
step. *changes*: of seats. The product goes by what is lost, not by age: bodies that lose little wait, which is what
p99 of the age tells, and those at rest wait longest."""


def fill(
    report: Report, plan: Plan, rows: list[dict[str, Any]], racks: list[dict[str, Any]], capacity: ModuleType, *,
    quick: bool,
) -> None:  # fmt: skip
    """Writes everything into a report."""
    choosing = capacity.of_choosing((10, 100) if quick else (10, 100, 1000, 4000), 3 if quick else 20)
    parts = {"bodies": capacity.of_cores(), "factors": capacity.of_factors(), "users": capacity.of_users()}
    for title, text, table in (
        ("Bodies of a core and of a GPU", BODIES, parts["bodies"]), ("Factors", FACTORS, parts["factors"]),
        ("What a user costs", USERS, parts["users"]), ("What choosing costs", CHOOSING, choosing),
        ("Servers that share pools", words(plan), rows), ("A lost rack of workers", RACKS, racks),
    ):  # fmt: skip
        report.say(f"## {title}", text)
        report.table(table)
    report.say("## Which limit comes first", LIMITS)
    report.figure(picture(rows), "scale.png", "Age of factors of bodies in hands, and what it costs, under each choice")
    report.data |= {**parts, "choosing": choosing, "servers": rows, "racks": racks}


def picture(rows: list[dict[str, Any]]) -> Any:
    """Ages, lost time and use of workers and routers, a bar for each run."""
    plt = plots()
    figure, axes = plt.subplots(1, 3, figsize=(12, 4), sharey=True, layout="constrained")
    names = [f"{row['what']}, {row['choice']}" for row in rows]
    for ax, title, columns in (
        (axes[0], "age of factors in hands [s]", ("age p50 s", "age p99 s")),
        (axes[1], "lost by a body in a hand [ms/s]", ("lost ms/s",)),
        (axes[2], "in use [%]", ("workers busy %", "busiest router %")),
    ):
        for k, column in enumerate(columns):
            height = 0.8 / len(columns)
            ax.barh([y + (k + 0.5) * height - 0.4 for y in range(len(rows))], [row[column] for row in rows], height,
                    label=column)  # fmt: skip
        ax.set(title=title, yticks=range(len(rows)), yticklabels=names)
        ax.legend(fontsize=8)
    axes[0].invert_yaxis()
    axes[0].set_xscale("log")
    return figure
