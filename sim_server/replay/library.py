# SPDX-License-Identifier: MIT
"""The library that made the factors of a log, where it is installed."""

from importlib.util import find_spec

from sim_server.replay.log import Recording
from sim_server.simulation import Simulation
from sim_server.updates.factor_source import Inline
from sim_server.updates.patterns import Patterns


def inline_source(simulation: Simulation, recording: Recording) -> tuple[Inline, str]:
    """Returns a source of factors that uses the library named in the log, if it is installed, and what is to be noted
    if another one is used."""
    made = [f for o in recording.objects.values() for f in o.factors.values()]
    recorded = {f.library for f in made if f.library} - {"native"}  # which is everywhere
    wanted = {_option(name) for name in recorded}
    choice = wanted.pop() if len(wanted) == 1 else "auto"
    if not _usable(choice):
        choice = "auto"
    other = wanted or (recorded and choice == "auto")
    note = f"factors of the log were made by {', '.join(sorted(recorded))}; here by another" if other else ""
    return Inline(Patterns.of(simulation), choice), note


def _option(name: str) -> str:
    """Option of Analysis for a library as named in a log, such as "cholmod 3.0.14" or "NVIDIA H200, float64"."""
    from precond_worker.factorization.factorize import ON_CPU

    gpu = next((f"gpu-{kind}" for kind in ("float32", "float64") if name.endswith(f", {kind}")), "")
    return gpu or next((known for known in ON_CPU if name.split()[0] == known), "auto")


def _usable(library: str) -> bool:
    if library == "cholmod":
        return find_spec("sksparse") is not None
    if not library.startswith("gpu"):
        return True
    from precond_worker.errors import DeviceUnusable
    from precond_worker.gpu.device import try_out

    try:
        try_out(library.removeprefix("gpu-"))
    except DeviceUnusable:
        return False
    return True
