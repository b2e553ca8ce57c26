# SPDX-License-Identifier: MIT
"""The tables of a scene file as pydantic models. `load` in __init__.py reads a file."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    PlainSerializer,
    PlainValidator,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from sim_server.errors import InputError
from sim_server.mesh import Mesh
from sim_server.scene.accuracy_options import MOST_LINEARIZATIONS, ROUNDING, AccuracyOptions
from sim_server.scene.effect_tables import checked_effects
from sim_server.scene.elements import Elements, element_errors, keeps_mid_nodes
from sim_server.scene.halving import check_halving
from sim_server.scene.holders import Holder, check_holders_on, holder_errors
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.live import Live
from sim_server.scene.materials import Material, with_material
from sim_server.scene.mesh_source import MeshSource
from sim_server.scene.obstacles import FRICTION, Obstacle, check_contact_on, contact_errors
from sim_server.scene.parameters import Count, File, Name, NotNegative, Parameters, Positive, complaint
from sim_server.scene.pose import Pose
from sim_server.scene.solver_options import SolverOptions
from sim_server.scene.ties import Attachment, Spring, tie_errors

if TYPE_CHECKING:
    from sim_server.mesh.skin import Skin


def _effects(scope: str) -> tuple[PlainValidator, PlainSerializer]:
    """Returns the validator and the serializer of a table of effects of one scope."""
    return PlainValidator(partial(_effects_of, scope)), PlainSerializer(_dumped_effects)


def _effects_of(scope: str, table: Any, info: ValidationInfo) -> dict[str, BaseModel]:
    return checked_effects(scope, table, info.context)


def _dumped_effects(effects: dict[str, BaseModel]) -> dict[str, Any]:
    return {name: params.model_dump(mode="json") for name, params in effects.items()}


class SceneObject(Parameters):
    """One deformable object."""

    name: Name = Field(description="part of keys, logs and commands")
    mesh: MeshSource
    skin: File | None = Field(
        default=None, description="a finer surface that moves with the mesh, for viewers; a file that meshio reads"
    )
    pose: Pose = Pose()
    material: str | Material | None = Field(
        default=None, description="by name: sets density and law, and is not there when the scene is resolved"
    )
    density: Positive | None = Field(
        default=None, description="[kg/m3]; 1000 if neither density, mass nor material is given"
    )
    mass: Positive | None = Field(default=None, description="of the whole object, instead of density [kg]")
    masses: Literal["volume", "equal"] = Field(
        default="volume", description="nodal masses: a quarter of each adjacent element, or the same for every node"
    )
    elements: Elements = Field(
        default="auto", description="of corotational and some hyperelastic laws: what shares one strain"
    )
    friction: Annotated[NotNegative | None, Live(0, 1.5)] = Field(
        default=None, description="coefficient of its surface [-]; 0.5 where the scene lists contact"
    )
    effects: Annotated[dict[str, BaseModel], *_effects("object")] = Field(
        default_factory=dict, description="what acts on it, by name"
    )

    _given: Mesh | None = PrivateAttr(None)
    _keeps_mid_nodes: bool = PrivateAttr(False)

    def choose_mid_nodes(self, integrator: IntegratorOptions) -> None:
        """Sets whether the mesh keeps its mid-nodes, which depends on the integrator."""
        self._keeps_mid_nodes = keeps_mid_nodes(self, integrator)

    def use_mesh(self, mesh: Mesh) -> None:
        """Sets the mesh to be used instead of the one that `mesh` names."""
        self._given = mesh

    @model_validator(mode="before")
    @classmethod
    def _of_its_material(cls, table: Any) -> Any:
        """Fills in what a material sets; without one, and without density and mass, an object has that of water."""
        if not isinstance(table, dict):
            return table
        table = with_material(table)
        if table.get("density") is None and table.get("mass") is None:
            return {**table, "density": 1000.0}
        return table

    @model_validator(mode="after")
    def _density_or_mass(self) -> "SceneObject":
        if self.density is not None and self.mass is not None:
            raise complaint(f"give density or mass, not both (density = {self.density:g}, mass = {self.mass:g})")
        return self

    def load_mesh(self) -> Mesh:
        """Returns the checked mesh at rest, before the pose. Raises InputError that names the object."""
        if self._given is not None:
            return self._given
        try:
            mesh = self.mesh.read(self._keeps_mid_nodes)
            return mesh.with_mid_nodes() if self.elements == "quadratic" else mesh
        except InputError as error:
            raise InputError(f"object {self.name!r}: {error}") from error

    def load_skin(self, mesh: Mesh) -> "Skin | None":
        """Returns the skin embedded in the mesh, None without one. Raises InputError that names the object."""
        if self.skin is None:
            return None
        from sim_server.mesh.skin import read_skin

        try:
            return read_skin(self.skin, self.mesh.scale or 1.0, mesh)
        except InputError as error:
            raise InputError(f"object {self.name!r}: {error}") from error


class RecordOptions(Parameters):
    """The [record] table: what a log holds."""

    every: Count = Field(
        default=1, description="steps from one state frame to the next; per-step scalars are always recorded"
    )
    compression: Literal["lz4", "zstd", "none"] = Field(default="lz4", description="of the log")


def _some_objects(objects: list[SceneObject]) -> list[SceneObject]:
    if not objects:
        raise complaint("a scene needs at least one [[object]]")
    names = [o.name for o in objects]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise complaint(f"names must differ; more than once: {', '.join(twice)}")
    return objects


class Scene(Parameters):
    """A whole scene file."""

    dt: Positive = Field(description="time step [s]")
    name: Annotated[str, Field(min_length=1, max_length=200)] = Field(
        description="for logs and clients; that of the file if left out"
    )
    effects: Annotated[dict[str, BaseModel], *_effects("scene")] = Field(
        default_factory=dict, description="what acts on the whole scene, by name"
    )
    integrator: IntegratorOptions = IntegratorOptions()
    solver: SolverOptions = SolverOptions()
    accuracy: AccuracyOptions | None = None
    record: RecordOptions = RecordOptions()
    objects: Annotated[list[SceneObject], AfterValidator(_some_objects)] = Field(alias="object")
    obstacles: list[Obstacle] | None = Field(default=None, alias="obstacle", min_length=1)
    holders: list[Holder] | None = Field(default=None, alias="holder", min_length=1)
    attachments: list[Attachment] | None = Field(default=None, alias="attachment", min_length=1)
    springs: list[Spring] | None = Field(default=None, alias="spring", min_length=1)

    _path: Path = PrivateAttr(Path())
    _text: str = PrivateAttr("")

    @model_validator(mode="after")
    def _as_accuracy_needs(self) -> "Scene":
        """With a bound of the error in metres, tolerances that the scene does not give are rounding, and there are
        more linearizations where the scene may have them."""
        if self.accuracy is None:
            return self
        scheme, solve = self.integrator.scheme, self.integrator.solve
        if self.integrator.explicit:
            raise complaint(f'[accuracy] with integrator.scheme = "{scheme}", which solves no equations')
        if solve == "factor":
            raise complaint(
                '[accuracy] with integrator.solve = "factor", which makes steps without iterations; allowed: '
                '"auto", "iterate"'
            )
        if self.solver.preconditioner == "none":
            raise complaint(
                '[accuracy] with solver.preconditioner = "none", which tells nothing of errors; allowed: the others'
            )
        one_solve = scheme == "ros2" or self.solver.budget or self.attachments or self.springs
        given = self.integrator.model_fields_set
        if "contact" not in self.effects and not one_solve:
            more = {"linearizations": MOST_LINEARIZATIONS, "tolerance": ROUNDING}
            self._set("integrator", {key: value for key, value in more.items() if key not in given})
        if "tolerance" not in self.solver.model_fields_set:
            self._set("solver", {"tolerance": ROUNDING})
        return self

    def _set(self, table: str, values: dict[str, Any]) -> None:
        """Replaces values of a table; tables are frozen."""
        self.__dict__[table] = getattr(self, table).model_copy(update=values)

    @model_validator(mode="after")
    def _budget_of_a_step(self) -> "Scene":
        if self.solver.budget_ms is None:
            return self
        scheme, given, other = self.integrator.scheme, f"{self.solver.budget_ms:g}", self.solver.budget
        if scheme == "ros2" or self.integrator.explicit:
            raise complaint(
                f'solver.budget_ms = {given} with integrator.scheme = "{scheme}", which cannot end a '
                "step early; allowed: none"
            )
        if "contact" in self.effects and scheme != "backward_euler":
            raise complaint(
                f"solver.budget_ms = {given} with contact and integrator.scheme = "
                f'"{scheme}", which may make a step twice; allowed: "backward_euler"'
            )
        if "contact" in self.effects and self.integrator.linearizations > 1:
            raise complaint(
                f"solver.budget_ms = {given} with contact and integrator.linearizations = "
                f"{self.integrator.linearizations}: there is no search in contact that a budget ends; allowed: 1"
            )
        if other:
            raise complaint(f"solver.budget_ms = {given} with budget = {other:g}; allowed: one of both")
        return self

    @model_validator(mode="after")
    def _budget_of_one_solve(self) -> "Scene":
        if self.solver.budget and self.integrator.linearizations > 1:
            raise complaint(
                f"solver.budget = {self.solver.budget:g} with integrator.linearizations = "
                f"{self.integrator.linearizations}: a budget is for one solve a step; allowed: one of the two"
            )
        if self.solver.budget and "contact" in self.effects and self.integrator.scheme != "backward_euler":
            raise complaint(
                f"solver.budget = {self.solver.budget:g} with contact and integrator.scheme = "
                f'"{self.integrator.scheme}", which may make a step twice; allowed: "backward_euler"'
            )
        return self

    @model_validator(mode="after")
    def _halving(self) -> "Scene":
        listed = {"contact": "contact" in self.effects, "holders": self.holders}
        check_halving(self.solver, self.integrator, listed | {"attachments": self.attachments, "springs": self.springs})
        return self

    @model_validator(mode="after")
    def _factor_alone(self) -> "Scene":
        solver, solve = self.solver, self.integrator.solve
        if solve == "factor" and not solver.has_exact_factors:
            raise complaint(
                f'integrator.solve = "factor" with solver.preconditioner = "{solver.preconditioner}": the step is '
                'solved by an exact factor alone; allowed: "auto", "cholesky"'
            )
        if self.integrator.scheme == "ros2" and solver.budget:
            raise complaint(f'solver.budget = {solver.budget:g} with integrator.scheme = "ros2", which solves twice')
        return self

    @model_validator(mode="after")
    def _explicit_has_no_matrix(self) -> "Scene":
        """With an explicit scheme there is nothing to solve, to factorize or to warp."""
        if not self.integrator.explicit:
            return self
        scheme, solver = self.integrator.scheme, self.solver
        if solver.preconditioner not in ("auto", "none"):
            raise complaint(
                f'solver.preconditioner = "{solver.preconditioner}" with integrator.scheme = "{scheme}", which solves '
                'no equations; allowed: "auto", "none"'
            )
        if solver.budget:
            raise complaint(
                f'solver.budget = {solver.budget:g} with integrator.scheme = "{scheme}", which solves no equations; '
                "allowed: 0"
            )
        self._set("solver", {"preconditioner": "none", "warp": False})
        return self

    @property
    def uses_factor_alone(self) -> bool:
        """True if steps may be solved by the factor alone."""
        return self.integrator.scheme == "ros2" and self.integrator.solve != "iterate" and self.solver.has_exact_factors

    @model_validator(mode="after")
    def _as_the_integrator_needs(self) -> "Scene":
        """Adapts effects whose parameters depend on the scheme: they have a method `under(integrator)`."""
        errors: list[InitErrorDetails] = []
        for index, o in enumerate(self.objects):
            for name, params in o.effects.items():
                try:
                    o.effects[name] = params.under(self.integrator) if hasattr(params, "under") else params
                except PydanticCustomError as error:
                    place = ("object", index, "effects", name)
                    errors.append(InitErrorDetails(type=error, loc=place, input={}))
        if errors:
            raise ValidationError.from_exception_data("Scene", errors)
        return self

    @model_validator(mode="after")
    def _as_elements_need(self) -> "Scene":
        if errors := list(element_errors(self.objects, self.integrator)):
            raise ValidationError.from_exception_data("Scene", errors)
        for o in self.objects:
            o.choose_mid_nodes(self.integrator)
        return self

    @model_validator(mode="after")
    def _as_contact_needs(self) -> "Scene":
        """Checks obstacles and contact, and fills in the friction of objects where the scene lists contact."""
        given = self.effects.get("contact"), self.objects, self.obstacles or []
        if errors := list(contact_errors(*given, self.integrator)):
            raise ValidationError.from_exception_data("Scene", errors)
        if "contact" in self.effects:
            for index, o in enumerate(self.objects):
                if o.friction is None:
                    self.objects[index] = o.model_copy(update={"friction": FRICTION})
        return self

    @model_validator(mode="after")
    def _as_holders_need(self) -> "Scene":
        shapes = [o.name for o in self.obstacles or []]
        if errors := list(holder_errors(self.holders or [], self.objects, shapes)):
            raise ValidationError.from_exception_data("Scene", errors)
        return self

    @model_validator(mode="after")
    def _as_ties_need(self) -> "Scene":
        objects, shapes = [o.name for o in self.objects], [o.name for o in self.obstacles or []]
        taken = [*objects, *shapes, *(h.name for h in self.holders or [])]
        given = self.attachments or [], self.springs or [], objects, shapes, taken, self.integrator
        if errors := list(tie_errors(*given)):
            raise ValidationError.from_exception_data("Scene", errors)
        return self

    def check_device(self, device: str) -> None:
        """Raises InputError for what the device ("cpu" or "gpu") does not have."""
        self.solver.check_device(device)
        check_holders_on(device, self.holders or [], self.integrator)
        if "contact" in self.effects:
            check_contact_on(device, self.effects["contact"], self.integrator)
        if device == "gpu":
            self._check_budgets_on_gpu()

    def _check_budgets_on_gpu(self) -> None:
        """Raises InputError for a budget of wall time of solves that a GPU does not end by one."""
        between = [word for word in ("attachments", "springs") if getattr(self, word)]
        between += ["contact"] if "contact" in self.effects else []
        for name in ("budget", "budget_ms"):
            if between and (given := getattr(self.solver, name)):
                raise InputError(
                    f"solver.{name} = {given:g} with {between[0]} on a GPU, which ends no solve of several passes or "
                    "bodies by wall time; allowed: none, and max_iterations bounds a solve"
                )

    @property
    def projection(self) -> Literal["excess", "clamp", "absolute", "none"]:
        """solver.projection; for "auto": excess if only the matrix keeps a step from overshooting, else clamp."""
        if self.solver.projection != "auto":
            return self.solver.projection
        single = self.integrator.linearizations == 1 and self.integrator.scheme != "quasi_static"
        return "excess" if single else "clamp"

    @property
    def path(self) -> Path:
        """The file that the scene was read from; gallery/NAME if it comes with the package."""
        return self._path

    @property
    def text(self) -> str:
        """The file as read, before overrides."""
        return self._text

    def resolved(self) -> dict[str, Any]:
        """Returns the scene with defaults, as JSON types with the keys of a scene file: a valid scene again."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)
