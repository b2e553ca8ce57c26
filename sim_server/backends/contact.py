# SPDX-License-Identifier: MIT
"""Contact of surfaces with obstacles as input of an engine (law: kernels/contact_law.cuh, method: docs/contact.md)."""

from dataclasses import dataclass

from sim_server.arrays import Float64, Int32
from sim_server.backends.ties import Ties

MOST_MODES = 600  # of the coarse space of an island of bodies


@dataclass(frozen=True)
class Obstacles:
    """Rigid shapes and their poses in the step under way (functions: kernels/shapes.cuh).

    kind: (m,) ShapeKind. size: (m, 4) [m]. grid: all signed distances of GRIDs [m]; place: (m,) first entry of its own;
    cells: (m, 3) its nodes along x, y, z. begin, end: (m, 7) poses at the start and the end of the step, position [m]
    and unit quaternion w, x, y, z
    """

    kind: Int32
    size: Float64
    grid: Float64
    place: Int32
    cells: Int32
    begin: Float64
    end: Float64


@dataclass(frozen=True)
class Faces:
    """Triangles of surfaces, each with a row against obstacles (kernels/triangle_shape.cuh).

    start: (bodies + 1,) first row of each body. triangle: (triangles, 3) nodes of the scene, outward; in order of rows
    owns: (triangles,) bit k is set where the edge from corner k to the next one belongs to the triangle, as each edge
        does to one
    friction: (bodies, obstacles) coefficients. gravity: (3,) [m/s2]
    """

    start: Int32
    triangle: Int32
    owns: Int32
    friction: Float64
    gravity: Float64


@dataclass(frozen=True)
class OwnSurfaces:
    """What bodies need to touch themselves (detection: kernels/own_surface.cuh).

    near_start: (nodes + 1,) and near_node: of each node of a surface those that it does not touch, ascending, with
        itself
    start: (bodies + 1,) and node: all nodes of each body's surface
    """

    near_start: Int32
    near_node: Int32
    start: Int32
    node: Int32


@dataclass(frozen=True)
class Surfaces:
    """What bodies need to touch each other, or themselves (detection: kernels/pair_detection.cuh).

    site_body: (surface nodes,). node_site: (nodes,) number of a node among the surface nodes, -1: it is none
    triangle: (triangles, 3) nodes of the scene, outward; those of a body are together
    tree_start: (bodies + 1,) and tree_child: (boxes, 2) of each body's tree: two later boxes, or ~ of a triangle, twice
    edge_start: (bodies + 1,) first row of the edges of each body, two for each. edge: (edges, 2) nodes, as the triangle
        that owns the edge has them; opposite: (edges, 2) third corners of its two triangles
    triangle_edge: (triangles, 3) the edge from each corner to the next one that the triangle owns; -1
    edge_length: (bodies,) of edges in the mean [m]. thickness: (bodies,) [m]
    friction: (bodies, bodies) coefficients. gravity: (3,) [m/s2]
    between: whether bodies touch each other. own: None where they do not touch themselves
    """

    site_body: Int32
    node_site: Int32
    triangle: Int32
    tree_start: Int32
    tree_child: Int32
    edge_start: Int32
    edge: Int32
    opposite: Int32
    triangle_edge: Int32
    edge_length: Float64
    thickness: Float64
    friction: Float64
    gravity: Float64
    between: bool
    own: OwnSurfaces | None


@dataclass(frozen=True)
class Contact:
    """Rows of contacts, which launches among `assemble` fill in each step, and options.

    A row is a place where a surface may touch something: sum_a weight_a x_{corner_a}, against a plane that stands for
    it in this step. Those of a sort ascend by body; first come those against obstacles:

        two for each surface node: the node, with weight 1
        one for each triangle, if there are `faces`: its corners, which the loop sets
        two for each surface node, if there are `surfaces`: the node with weight 1 and a triangle of another body, or
            of its own, with weights below 0, which the loop sets
        two for each edge then: its nodes with weights 1 - s, s and those of another edge with -(1 - t), -t

    body_start: (bodies + 1,) rows of the nodes of each body against obstacles
    corner: (rows, 4) nodes of the scene; -1: fewer. weight: (rows, 4)
    obstacle: (rows,) number of the obstacle, or of the other body, which may be its own; -1: the row is empty
    normal: (rows, 3) unit, out of the obstacle, world frame
    gap: (rows,) signed distance of the point at the start of the step from where the plane is at the end of it [m]
    drift: (rows, 3) displacement in the step of the obstacle's point that is touched [m]
    entry: (rows,) when the point as predicted first comes nearer than the thickness, as a part of the step, 0 to 1;
        2: it does not
    stiffness: (rows,) [N/m], of rows between bodies set by the loop. friction: (rows,) coefficient
    thickness: (rows,) [m]. hardening: (rows,) what multiplies the stiffness: 1, or more in a contact whose force a
        sweep found too large for it, as long as that is so
    force: (rows,) normal force lambda [N]; traction: (rows, 3) friction force [N]. In: of the last step, for the same
        obstacle (0 for another), traction turned with the normal. Out: of this step
    predictor: (nodes, 3), dx_dv, force_coefficient, free, mass: (nodes,) of the world (mechanics/world.py)
    passes: most solves of a linearization. tolerance: of the contact residual
    dropped: (surface nodes,) how often something that touches found no row; of a triangle at one of its nodes
    faces: None where triangles have no rows of their own
    surfaces: None where bodies touch neither each other nor themselves
    ties: attachments and springs, which have the last rows; None: there are none
    """

    obstacles: Obstacles
    body_start: Int32
    corner: Int32
    weight: Float64
    obstacle: Int32
    normal: Float64
    gap: Float64
    drift: Float64
    entry: Float64
    stiffness: Float64
    friction: Float64
    thickness: Float64
    hardening: Float64
    force: Float64
    traction: Float64
    predictor: Float64
    free: Float64
    mass: Float64
    dx_dv: float
    force_coefficient: float
    passes: int
    tolerance: float
    dropped: Int32
    faces: Faces | None
    surfaces: Surfaces | None
    ties: Ties | None = None
