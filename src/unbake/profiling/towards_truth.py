"""The way from fitted materials to the true ones, as a parameter that a loss can be derived by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..fields.domain import SurfacePoint
from ..fields.envmap import environment_emitter
from ..fields.field import Cost, Engine, Field
from ..fields.materials import Materials
from ..fields.registry import representation
from ..fields.texture import material_numbers, material_textures, texture_base
from ..quantities import QUANTITIES
from ..scene import edit
from ..scene.parse import parse
from ..training.problem import Problem, known_materials
from ..training.recovered import Recovered
from ..transport.vertex import SceneView

#: The parameter of a field that tells how far its quantity has gone, [0,1].
WAY = "way"
_PLUGIN = "unbake_towards_truth"


class TowardsTruth(Field):
    """A field with one more parameter: the part of the way to the truth that is gone, 0 at first.

    The field itself stays as it was fitted. Textures of `towards_truth` add the way at each point.

    Args:
        field: the fitted one.
    """

    def __init__(self, field: Field) -> None:
        self.field = field
        self.recordable = field.recordable
        self.prepare_recordable = field.prepare_recordable
        self.symbolic = field.symbolic
        #: Textures hold it too.
        self.tables = {WAY: dr.opaque(mi.Float, 0)}

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """Those of the field, and the way."""
        return {**self.field.parameters(), **self.tables}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.field.assign({key: parameters[key] for key in self.field.parameters()})
        self.tables[WAY] = parameters[WAY]

    def prepare(self) -> None:
        """Prepare the field."""
        self.field.prepare()

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """The fitted values."""
        return self.field.evaluate(point, extra, engine)

    def cost(self) -> Cost:
        """That of the field."""
        return self.field.cost()


def towards_truth(recovered: Recovered) -> Problem:
    """The problem of a run, with BSDFs that can go from fitted materials to the true ones.

    At a point x, a quantity is (1 − t) · fitted(x) + t · true(x), where t is the parameter `WAY` of
    its field, and true(x) is the texture that the scene has there. Only BSDFs see it: the albedo
    that L_θ is told, and the points of regularizers, are the fitted ones.

    Args:
        recovered: a run whose data set has the true materials.

    Raises:
        UserError: the scene cannot be loaded.
    """
    problem = recovered.problem
    assert problem.materials is not None
    fields = {name: TowardsTruth(fitted) for name, fitted in problem.materials.items()}
    materials = Materials(fields)
    materials.domain = problem.materials.domain
    scene = _scene(recovered, materials, fields)
    if representation(recovered.config.representation).unwrapped:
        materials.numbers = material_numbers(scene)
    materials.pieces = problem.materials.pieces
    if materials.pieces is not None:
        materials.pieces.attach(scene)
    specular = recovered.config.transport.max_specular
    return replace(
        problem, scene_view=SceneView.of(scene, materials, specular), materials=materials
    )


def _scene(
    recovered: Recovered, materials: Materials, fields: Mapping[str, TowardsTruth]
) -> mi.Scene:
    """The scene, with textures that go from the fields to its own."""
    problem, dataset = recovered.problem, recovered.dataset
    parsed = parse(dataset.scene, dataset.root)
    edit.to_principled(parsed)
    _register()
    wrapped: list[dict[str, mi.Texture]] = []
    known = known_materials(parsed, recovered.config)
    for number in range(len(edit.material_names(parsed))):
        if number in known:
            wrapped.append({})
            continue
        fitted = material_textures(materials, number)
        for name, field in fields.items():
            # A frozen function calls all textures that there are, those of other scenes too. What
            # they read it finds in their attributes alone.
            fitted[QUANTITIES[name].slot].tables = field.tables
        wrapped.append(fitted)
    edit.wrap_textures(parsed, _PLUGIN, wrapped)
    if problem.environment is not None:
        edit.set_environment(parsed, environment_emitter(problem.environment))
    return parsed.instantiate()


def _register() -> None:
    """Make the texture known to Mitsuba."""

    class WayTexture(texture_base(mi.variant())):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.fitted = props["fitted"]
            self.true = props.get_texture("own")
            self.tables = self.fitted.tables

        def eval(self, si, active=True):
            true = mi.Color3f(self.true.eval(si, active))
            return dr.lerp(self.fitted.eval(si, active), true, self.tables[WAY])

        def eval_1(self, si, active=True):
            true = self.true.eval_1(si, active)
            return dr.lerp(self.fitted.eval_1(si, active), true, self.tables[WAY])

        def traverse(self, callback):
            callback.put("fitted", self.fitted, mi.ParamFlags.NonDifferentiable)

        def to_string(self):
            return f"WayTexture[{self.fitted.quantity}]"

    mi.register_texture(_PLUGIN, WayTexture)
