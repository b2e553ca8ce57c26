# SPDX-License-Identifier: MIT
"""Elements that a scene and its parameters have removed from an object, and what is left without them."""

import json
from collections.abc import Sequence

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.errors import InputError
from sim_server.mechanics.numbers import numbers_of, text_of
from sim_server.mechanics.splitting import Splitting
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene

KEY = "object.{}.effects.cutting.removed"  # of the parameter, by the object's name
LEAST_MASS = 1e-6  # of its own, which a node without elements keeps, since equations divide by it


def removed_from(scene: Scene, body: Body) -> Int64:
    """Returns the numbers of the elements that a scene has removed from an object. Raises InputError."""
    params = scene.objects[body.index].effects.get("cutting")
    if params is None:
        return np.zeros(0, np.int64)
    try:
        return numbers_of(params.removed, len(body.mesh.tets))  # type: ignore[attr-defined]
    except ValueError as error:
        raise InputError(f"object {body.name!r}, effect cutting: removed: {error}") from None


def removal(scene: Scene, body: Body, numbers: Int64) -> dict[str, str]:
    """Returns the parameter, by its key as TOML, with which a scene has no such elements either."""
    return {KEY.format(body.name): json.dumps(text_of(np.append(removed_from(scene, body), numbers)))}


def present(scene: Scene, bodies: Sequence[Body]) -> Float64:
    """Returns 1 for each element of these bodies, one after another, 0 for those that the scene has removed."""
    parts = [np.ones(len(body.mesh.tets)) for body in bodies]
    for body, part in zip(bodies, parts, strict=True):
        part[removed_from(scene, body)] = 0
    return np.concatenate(parts)


def present_nodes(scene: Scene, world: World) -> Float64:
    """Returns the part of each node's elements that is left by volume, (nodes,): 1 where none was removed, 0 if all."""
    out = np.ones(world.nodes)
    for body in world.bodies:
        removed = removed_from(scene, body)
        if world.splitting is not None and body.index in world.splitting.splitters:
            out[body.nodes] = _shares(world.splitting, scene, body)
        elif len(removed):
            size = body.mesh.volumes
            gone = np.zeros(len(size))
            gone[removed] = size[removed]
            n, corners = body.last - body.first, body.mesh.tets.ravel()
            whole = np.bincount(corners, weights=np.repeat(size, 4), minlength=n)
            left = np.bincount(corners[np.repeat(gone == 0, 4)], minlength=n)
            lost = np.bincount(corners, weights=np.repeat(gone, 4), minlength=n)
            out[body.nodes] = np.where(left > 0, 1 - lost / np.where(whole > 0, whole, 1), 0)
    return out


def _shares(splitting: Splitting, scene: Scene, body: Body) -> Float64:
    """Returns the part of the elements of its root that each node of a body that may be split has, by volume, (n,)."""
    split, splitter = splitting.of(scene, body.index), splitting.splitters[body.index]
    n, size, present = len(split.origin), body.mesh.volumes, np.ones(len(body.mesh.tets))
    present[removed_from(scene, body)] = 0
    whole = np.bincount(splitter.whole.tets.ravel(), weights=np.repeat(size, 4), minlength=n)
    here = np.bincount(split.tets.ravel(), weights=np.repeat(size * present, 4), minlength=n)
    root = whole[split.root]
    return here / np.where(root > 0, root, 1)


def whole_masses(scene: Scene, world: World, masses: Float64) -> Float64:
    """Returns the masses of the nodes from which nodes were copied, (nodes,) [kg]. masses: of the whole meshes"""
    if world.splitting is None:
        return masses
    found = masses[world.splitting.nodes(scene, "root")]
    for index in world.splitting.splitters:  # spare nodes that are left have some, since equations divide by it
        own = found[world.bodies[index].nodes]
        own[own == 0] = own.mean()
    return found


def masses_left(part: Float64, masses: Float64) -> Float64:
    """Returns the nodal masses without removed elements [kg]. part: of present_nodes; masses: with all elements."""
    return np.where(part > 0, part, LEAST_MASS) * masses
