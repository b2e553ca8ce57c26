# SPDX-License-Identifier: MIT
"""What one scene of the GPU benchmark comes to: one row."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from tests.bench.gpu import traffic as moved
from tests.bench.gpu.steps import WITHOUT, Beams, Found, Search

Row = dict[str, Any]


def row(beams: Beams, found: Found) -> Row:
    """us are of a step of all beams together; iterations, residual and age of one beam."""
    from protocol import messages_pb2 as pb

    records = np.concatenate(found.records)
    age = (records["step"] - 1 - records["factor_step"])[records["factor_step"] >= 0]
    problem, iterations = beams.problem, float(records["iterations"].mean())
    size = beams.size()
    return {
        "tets": problem.tets, "material": problem.material, "beams": problem.beams,
        **_times(records, "us"), "between us": 1e6 * found.between, "host CPU us": 1e6 * found.cpu,
        "solve us": 1e6 * float(np.median(_first(records)["solve"])),
        **_stages(records), "iterations": iterations, "most": int(records["iterations"].max()),
        "residual": max(found.residuals), "reported residual": float(records["residual"].max()),
        "unconverged": int((records["status"] != pb.CONVERGED).sum()),
        "factor age": float(age.mean()) if len(age) else None, "oldest": int(age.max()) if len(age) else None,
        "factor ms": float(np.median(found.made)) if found.made else None,
        "expansion ms": float(np.median(found.taken)) if found.taken else None,
        "library": beams.analysis.library if beams.analysis else "none",
        "phases": phases(beams) if problem.beams == 1 and size.factor else None,
        **{f"MB {what}": mb for what, mb in moved.step(size, iterations).items()},
        **_without(found),
    }  # fmt: skip


def search_row(beams: Beams, search: Search, found: Found) -> Row:
    """A scene with several linearizations; made: of them, mean of a step."""
    records = np.concatenate(found.records)
    return {
        "tets": beams.problem.tets, "linearizations": search.most, "needed": search.needed,
        "tolerance": search.tolerance, **_times(records, "us"),
        "solve us": 1e6 * float(np.median(_first(records)["solve"])),
        "made": float(records["linearizations"].mean()), "iterations": float(records["iterations"].mean()),
    }  # fmt: skip


def phases(beams: Beams) -> int | None:
    """Of an application of the factor that the first beam has on a GPU, a barrier each; None where there is none."""
    solver = getattr(beams.engine, "solver", None)
    if solver is None or not hasattr(solver, "begin_plan") or beams.analysis is None:
        return None
    planes = solver.planes or 1  # what beams get where the server chooses
    return int(solver.begin_plan(0, beams.analysis.pattern, planes).result().plan.plan.phases)


def _stages(records: NDArray[Any]) -> Row:
    """Shares of steps in %, by form, of a scheme with stages; the largest estimated error of a step."""
    if not records["form"].any():
        return {}
    shares = {name.lower(): 100 * float((records["form"] == form).mean()) for name, form in FORMS.items() if form}
    return {**{f"by {name} %": share for name, share in shares.items()}, "estimate m": float(records["estimate"].max())}


def _first(records: NDArray[Any]) -> NDArray[Any]:
    """One record a step: a step of all bodies is one step."""
    return records[records["body"] == 0]


def _times(records: NDArray[Any], name: str) -> Row:
    us = 1e6 * _first(records)["whole"]
    p50, p99, most = (float(np.percentile(us, q)) for q in (50, 99, 100))
    return {f"{name} p50": p50, f"{name} p99": p99, f"{name} max": most}


def _without(found: Found) -> Row:
    out: Row = {}
    for name in WITHOUT.values():
        parts = [records for records in found.without[name] if len(records)]
        if not parts:
            continue
        records = np.concatenate(parts)
        out[f"{name} us"] = 1e6 * float(np.median(_first(records)["whole"]))
        out[f"{name} solve us"] = 1e6 * float(np.median(_first(records)["solve"]))
        out[f"{name} iterations"] = float(records["iterations"].mean())
    return out
