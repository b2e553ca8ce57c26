# SPDX-License-Identifier: MIT
"""Soft blocks over a floor in MuJoCo, as flexes: `python peer_mujoco.py PROBLEM.json RESULT.npz`.

It imports nothing of ours: the Python that runs it is one where `mujoco` is installed. What goes in and out is told in
peers.py. Nodes get the masses of the problem; a flex has no damping. Contact of a node with the floor begins at the
flex's radius, that of two flexes at twice that, so a radius is all of the distance, or half of it.
"""

import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

INERTIA = 1e-8  # of a node [kg m2]: it does not turn


def text(problem: dict) -> str:
    """MJCF. y is up."""
    s, several = problem["settings"], len(problem["bodies"]) > 1
    contact = (
        f'<contact selfcollide="none" condim="3" friction="{problem["friction"]} 0 0" '
        f'solref="{s["solref"]}" solimp="{s["solimp"]}"/>'
    )
    flexes = ""
    for k, body in enumerate(problem["bodies"]):
        points = " ".join(f"{c:.17g}" for x in body["x"] for c in x)
        elements = " ".join(str(node) for tet in problem["tets"] for node in tet)
        flexes += f"""
        <flexcomp name="b{k}" type="direct" dim="3" point="{points}" element="{elements}" mass="1"
                  radius="{problem["distance"] / (2 if several else 1)}">
            <elasticity young="{problem["young"]}" poisson="{problem["poisson"]}" damping="0"/>{contact}
        </flexcomp>"""
    gravity = " ".join(str(c) for c in problem["gravity"])
    lift = problem["distance"] / 2 if several else 0.0  # of the floor: the radius is that much too small
    return f"""
    <mujoco>
        <option timestep="{problem["dt"]}" gravity="{gravity}" integrator="{s["integrator"]}" solver="{s["solver"]}"
                iterations="{s["iterations"]}" tolerance="{s["tolerance"]}" cone="elliptic"
                impratio="{s["impratio"]}"/>
        <size memory="1G"/>
        <worldbody>
            <geom type="plane" size="50 50 1" pos="0 {lift} 0" xyaxes="1 0 0 0 0 -1" condim="3"
                  friction="{problem["friction"]} 0 0" solref="{s["solref"]}" solimp="{s["solimp"]}"/>{flexes}
        </worldbody>
    </mujoco>"""


def normal_force(data: mujoco.MjData) -> float:
    """On the floor, which is geom 0 [N]."""
    rows = [c.efc_address for c in data.contact if 0 in c.geom and c.efc_address >= 0]
    return float(data.efc_force[rows].sum())


def main() -> None:
    problem = json.loads(Path(sys.argv[1]).read_text())
    model = mujoco.MjModel.from_xml_string(text(problem))
    mass = np.concatenate([body["mass"] for body in problem["bodies"]])
    v = np.concatenate([np.tile(body["v"], (len(body["x"]), 1)) for body in problem["bodies"]])
    node = np.array(model.flex_vertbodyid)
    model.body_mass[node], model.body_inertia[node] = mass, INERTIA
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    for k, of in enumerate(node):  # three slides a node, along x, y, z
        first = model.body_dofadr[of]
        data.qvel[first : first + 3] = v[k]
    mujoco.mj_forward(model, data)
    x, seconds, floor = [], [], []
    for _ in range(problem["frames"]):
        begun = time.process_time()
        for _ in range(problem["substeps"]):
            mujoco.mj_step(model, data)
        seconds.append(time.process_time() - begun)
        x.append(np.array(data.flexvert_xpos))
        floor.append(normal_force(data))
    warned = {w.name: int(data.warning[w.value].number) for w in mujoco.mjtWarning.__members__.values()
              if w.name != "mjNWARNING" and data.warning[w.value].number}  # fmt: skip
    np.savez(sys.argv[2], x=np.array(x), seconds=np.array(seconds), floor=np.array(floor),
             version=f"MuJoCo {mujoco.__version__}", notes=json.dumps(warned) if warned else "")  # fmt: skip


if __name__ == "__main__":
    main()
