"""Emitters that light more of what cameras see are sampled more often (ours).

Mitsuba chooses among emitters with equal probability, whatever they give. In a room with one bright
lamp and some that glow, most shadow rays are spent on the latter.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.materials import carrying
from .emitter_sampling import sample_emitter
from .vertex import Scattering, SceneView, Vertex, evaluate, find_vertex, mis_weight

#: Camera rays that tell what is lit, and emitter samples at each of their first two vertices.
RAYS = 2048
_SAMPLES = 32
#: Share of the choices that is left to all emitters alike: what lights no sampled point may light
#: others.
_ALIKE = 0.2
#: Light of a point, as a fraction of the mean, below which it counts less.
_DIM = 0.05
_WEIGHT = "sampling_weight"


def chosen_alike(scene: mi.Scene) -> bool:
    """Whether a scene has several emitters that are on, and nobody said how often each is sampled.

    Those that are turned off have the weight 0.
    """
    weights = [float(mi.traverse(emitter)[_WEIGHT]) for emitter in scene.emitters()]
    return len([w for w in weights if w > 0]) > 1 and {*weights} <= {0.0, 1.0}


@carrying()
def weigh_emitters(scene_view: SceneView, ray: mi.Ray3f, *, hide_emitters: bool, seed: int) -> None:
    """Set how often emitters of a scene are sampled, by how much light they bring to surfaces.

    Where rays first meet a surface, and where a diffuse bounce from there does, each emitter has a
    share of the light that arrives. Errors are relative, so shares count, and not light; and their
    root mean squares, by which noise is least. Mitsuba's integrators choose by the same weights:
    expectations stay as they are.

    Args:
        scene_view: whose scene is changed; see `chosen_alike`.
        ray: camera rays.
        hide_emitters: as in `find_vertex`.
        seed: decides the random numbers.
    """
    scene, emitters = scene_view.scene, scene_view.scene.emitters()
    numbers = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(e))[0]) for e in emitters]
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(ray))
    with dr.suspend_grad():
        first = find_vertex(scene_view, ray, mi.Bool(True), sampler, hide_emitters=hide_emitters)
        further = mi.Frame3f(first.n).to_world(
            mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        )
        evaluate(sampler, further)
        origin = Scattering(first.si, mi.Float(1), mi.Bool(True))
        second = find_vertex(
            scene_view, first.si.spawn_ray(further), first.valid, sampler, origin=origin
        )
        count = max(numbers) + 1
        found = np.sum(
            [
                _squared_shares(scene_view, vertex, 2 * seed + number, count)
                for number, vertex in enumerate((first, second), 1)
            ],
            axis=0,
        )
    shares = np.sqrt(found[numbers])
    if shares.sum() <= 0:
        return
    weights = [mi.traverse(emitter) for emitter in emitters]
    on = np.array([float(weight[_WEIGHT]) > 0 for weight in weights])
    shares = np.where(on, shares, 0)
    chances = (1 - _ALIKE) * shares / shares.sum() + _ALIKE * on / on.sum()
    for weight, chance in zip(weights, (chances * on.sum()).tolist(), strict=True):
        weight[_WEIGHT] = chance
        weight.update()
    scene.parameters_changed()


def _squared_shares(scene_view: SceneView, vertex: Vertex, seed: int, count: int) -> np.ndarray:
    """Sums of squared shares of the light at vertices, by registry numbers below a count.

    A share is what a sample finds, less what MIS leaves to directions that the BSDF draws, of all
    that the samples of its vertex find. Its mean square is the variance that an emitter brings.
    """
    points = dr.width(vertex.valid)
    lane = dr.arange(mi.UInt32, points * _SAMPLES) // _SAMPLES
    dr.eval(lane)
    x = vertex.gathered(lane)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(lane))
    ds, light = sample_emitter(
        scene_view.scene, x.si, sampler.next_2d(), x.valid, holes=scene_view.has_holes
    )
    cosine = dr.maximum(dr.dot(x.n, ds.d), 0)
    found = dr.mean(light) * cosine
    found = dr.select(x.valid & (ds.pdf != 0) & dr.isfinite(found), found, 0)
    left = dr.select(ds.delta, 1, mis_weight(ds.pdf, cosine * dr.inv_pi))
    emitter = dr.reinterpret_array(mi.UInt32, ds.emitter)
    # Sums in Dr.Jit differ in their last bits from run to run.
    numbers = np.array(emitter)
    values, weight = (np.array(v, np.float64).reshape(points, _SAMPLES) for v in (found, left))
    total = values.mean(axis=1, keepdims=True)
    total = np.maximum(total, _DIM * total.mean())
    shares = np.divide(values * weight, total, out=np.zeros_like(values), where=total > 0)
    return np.bincount(numbers, shares.ravel() ** 2, minlength=count)[:count]
