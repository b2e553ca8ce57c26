# SPDX-License-Identifier: MIT
"""Kinds of elements that an object may have, and what each needs of its effects and of the integrator."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol

from pydantic_core import InitErrorDetails

from sim_server.mesh import Mesh
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.parameters import complaint

Elements = Literal["auto", "linear", "patch", "smoothed", "quadratic"]
Kind = Literal["linear", "patch", "smoothed", "quadratic"]
LAWS = ("arruda_boyce", "costa", "mooney_rivlin", "neo_hookean", "ogden", "stable_neo_hookean", "st_venant_kirchhoff",
        "veronda_westmann")  # fmt: skip
PATCHED = ("arruda_boyce", "mooney_rivlin", "neo_hookean", "stable_neo_hookean", "veronda_westmann")  # may be "patch"


REMEMBERING = ("damage", "plasticity", "poroelasticity", "prony")  # beside laws of linear tetrahedra


class HasElements(Protocol):
    """An object of a scene, as far as its elements go."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def elements(self) -> Elements:
        """As the scene gives it."""

    @property
    def effects(self) -> dict[str, Any]:
        """Parameters by name of the effect."""


def element_errors(objects: Sequence[HasElements], integrator: IntegratorOptions) -> Iterator[InitErrorDetails]:
    """Yields an error for each object whose effects or integrator have no such elements."""
    for index, o in enumerate(objects):
        wrong = "" if o.elements in ("auto", "linear") else _reason(o.elements, o.effects, integrator)
        if wrong:
            message = f'elements = "{o.elements}" {wrong}'
            yield InitErrorDetails(type=complaint(message), loc=("object", index, "elements"), input=o.elements)


def kind_of_elements(o: HasElements, mesh: Mesh | None, integrator: IntegratorOptions) -> Kind:
    """Returns the kind that an object with this mesh has. None: a bar, whose nodes are corners"""
    if o.elements != "auto":
        return o.elements
    others: Kind = "smoothed" if mesh is None or mesh.quadratic is None else "quadratic"
    return "linear" if _reason(others, o.effects, integrator) else others


def keeps_mid_nodes(o: HasElements, integrator: IntegratorOptions) -> bool:
    """Returns whether an object has quadratic elements if its mesh has mid-nodes."""
    return o.elements == "quadratic" or (o.elements == "auto" and not _reason("quadratic", o.effects, integrator))


def _reason(elements: Elements, effects: Mapping[str, Any], integrator: IntegratorOptions) -> str:
    """Returns why an object cannot have such elements, other than linear ones; empty if it may."""
    if "cutting" in effects:
        return 'with the effect cutting, which removes linear elements alone; allowed: "auto", "linear"'
    if found := [name for name in REMEMBERING if name in effects]:
        return f'with the effect {found[0]}, which has linear elements alone; allowed: "auto", "linear"'
    laws = [name for name in LAWS if name in effects]
    if linear := [name for name in laws if name not in PATCHED]:
        return f'with the effect {linear[0]}, which has linear elements alone; allowed: "auto", "linear"'
    if laws and elements != "patch":
        return f'with the effect {laws[0]}, whose elements are linear or in patches; allowed: "auto", "linear", "patch"'
    if not laws and "corotational" not in effects:
        others = f" or one of {', '.join(PATCHED)}" if elements == "patch" else ""
        return f'without the effect corotational{others}, which alone have such elements; allowed: "auto", "linear"'
    if "corotational" in effects and effects["corotational"].rotation == "qr":
        return 'with corotational.rotation = "qr", which is that of tetrahedra; allowed: "auto", "linear"'
    if "growth" in effects:
        return 'with the effect growth, which linear elements alone have; allowed: "auto", "linear"'
    if integrator.explicit:
        given = f'integrator.scheme = "{integrator.scheme}"'
        return f'with {given}, which has linear elements alone; allowed: "auto", "linear"'
    return ""
