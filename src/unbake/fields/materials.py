"""The unknown materials φ: albedo and roughness as functions of position (Sec. 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..config import NetworkConfig
from .domain import Domain
from .network import Engine, Network

ROUGHNESS_FLOOR = 0.02  #: below it, the microfacet density overflows single precision


@dataclass
class Material:
    """Albedo (linear RGB, [0,1]) and perceptual roughness (α_GGX = roughness², [0.02,1])."""

    albedo: mi.Color3f
    roughness: mi.Float


class Materials:
    """Albedo and roughness fields, a network for each.

    Roughness shows far less in photographs than albedo does, so that its network may well be
    coarser.

    Paper: Sec. 5.1, 5.3.
    """

    def __init__(self, albedo: NetworkConfig, roughness: NetworkConfig, *, seed: int) -> None:
        #: Set once the scene's extent is known, before the first evaluation. (The scene is made
        #: with textures of these materials in it.)
        self.domain = Domain.unit()
        self.networks = {
            "albedo": Network(albedo, extra=0, outputs=3, seed=seed),
            "roughness": Network(roughness, extra=0, outputs=1, seed=seed + 1),
        }
        #: Whether textures read the values put on the surface interaction by `carry`. It must not
        #: change between an evaluation and its differentiation, which calls the textures again.
        self.carried = True

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays φ by name."""
        return {
            f"{name}.{key}": value
            for name, network in self.networks.items()
            for key, value in network.parameters().items()
        }

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        for name, network in self.networks.items():
            network.assign({k: parameters[f"{name}.{k}"] for k in network.parameters()})

    def stand_alone(self) -> None:
        """From now on, textures evaluate the networks themselves, as stock integrators need it."""
        for network in self.networks.values():
            network.pack()
        self.carried = False

    def albedo_at(self, p: mi.Point3f, valid: mi.Bool) -> mi.Color3f:
        """The albedo alone, where no BSDF will be asked."""
        raw = self.networks["albedo"](self.domain.to_unit(p, valid), [])
        return mi.Color3f([_sigmoid(x) for x in raw])

    def evaluate(self, p: mi.Point3f, valid: mi.Bool, engine: Engine = "tensor") -> Material:
        """The materials at world positions `p`; see `Network.__call__` for the engines."""
        unit = self.domain.to_unit(p, valid)
        albedo = [_sigmoid(x) for x in self.networks["albedo"](unit, [], engine)]
        (roughness,) = self.networks["roughness"](unit, [], engine)
        roughness = dr.fma(_sigmoid(roughness), 1 - ROUGHNESS_FLOOR, ROUGHNESS_FLOOR)
        return Material(mi.Color3f(albedo), roughness)


def carry(si: mi.SurfaceInteraction3f, material: Material) -> None:
    """Put the materials of a vertex on its surface interaction, for the textures to read.

    They travel in `dn_du` and `dn_dv`, which no BSDF uses. So networks run once a vertex, as matrix
    products outside of any virtual call, however often BSDFs ask for their textures.
    """
    si.dn_du = mi.Vector3f(material.albedo)
    si.dn_dv = mi.Vector3f(material.roughness, 0, 0)


def _sigmoid(x: mi.Float) -> mi.Float:
    return dr.rcp(1 + dr.exp(-x))
