# SPDX-License-Identifier: MIT
"""A soft bar held at some nodes in MuJoCo: `python peers_mujoco.py PROBLEM.json RESULT.npz`.

It imports nothing of ours: the Python that runs it is one where `mujoco` is installed. What goes in and out is told in
peers.py. Its law is that of St. Venant and Kirchhoff. Nodes get the masses of the problem; there is no damping.
"""

import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

INERTIA = 1e-8  # of a node [kg m2]: it does not turn


def text(problem: dict) -> str:
    """MJCF."""
    s = problem["settings"]
    points = " ".join(f"{c:.17g}" for x in problem["x"] for c in x)
    elements = " ".join(str(node) for tet in problem["tets"] for node in tet)
    held = " ".join(str(node) for node in problem["held"])
    gravity = " ".join(str(c) for c in problem["gravity"])
    return f"""
    <mujoco>
        <option timestep="{problem["dt"]:.17g}" gravity="{gravity}" integrator="{s["integrator"]}"
                solver="{s.get("solver", "CG")}" tolerance="{s.get("tolerance", 1e-10)}" iterations="1000">
            <flag contact="disable"/>
        </option>
        <size memory="1G"/>
        <worldbody>
            <flexcomp name="bar" type="direct" dim="3" point="{points}" element="{elements}" mass="1" radius="0.001">
                <elasticity young="{problem["young"]}" poisson="{problem["poisson"]}" damping="0"/>
                <contact selfcollide="none"/>
                <pin id="{held}"/>
            </flexcomp>
        </worldbody>
    </mujoco>"""


def made(problem: dict) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """With the masses of the problem."""
    model = mujoco.MjModel.from_xml_string(text(problem))
    free = np.setdiff1d(np.arange(len(problem["x"])), problem["held"])
    of = np.array(model.flex_vertbodyid)[free]
    model.body_mass[of], model.body_inertia[of] = np.array(problem["mass"])[free], INERTIA
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    return model, data


def main() -> None:
    problem = json.loads(Path(sys.argv[1]).read_text())
    model, data = made(problem)
    x, seconds = [], []
    for _ in range(problem["frames"]):
        begun = time.process_time()
        for _ in range(problem["substeps"]):
            mujoco.mj_step(model, data)
        seconds.append(time.process_time() - begun)
        x.append(np.array(data.flexvert_xpos))
    warned = {w.name: int(data.warning[w.value].number) for w in mujoco.mjtWarning.__members__.values()
              if w.name != "mjNWARNING" and data.warning[w.value].number}  # fmt: skip
    bad = [name for name in warned if "BADQ" in name]  # then it begins again from the start
    np.savez(sys.argv[2], x=np.array(x), seconds=np.array(seconds), version=f"MuJoCo {mujoco.__version__}",
             notes=json.dumps(warned) if warned else "", diverged=", ".join(bad))  # fmt: skip


if __name__ == "__main__":
    main()
