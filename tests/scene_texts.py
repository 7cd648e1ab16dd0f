"""Scenes that tests of parsing, editing and emitters share."""

import mitsuba as mi
import numpy as np

DIFFUSE = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6 0.3 0.1"/></bsdf>'
ROUGHPLASTIC = (
    '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.6 0.3 0.1"/>'
    '<float name="alpha" value="0.04"/><float name="int_ior" value="1.7"/></bsdf>'
)
PRINCIPLED = (
    '<bsdf type="principled"><rgb name="base_color" value="0.6 0.3 0.1"/>'
    '<float name="roughness" value="0.2"/></bsdf>'
)
WRAPPERS = {
    "alone": "{}",
    "twosided": '<bsdf type="twosided">{}</bsdf>',
    "mask": '<bsdf type="mask"><float name="opacity" value="0.7"/>{}</bsdf>',
    "bumpmap": '<bsdf type="bumpmap"><texture type="bitmap" name="bump">'
    '<string name="filename" value="bump.exr"/></texture>{}</bsdf>',
    "normalmap": '<bsdf type="normalmap"><rgb name="normalmap" value="0.5 0.5 1"/>{}</bsdf>',
    "all": '<bsdf type="mask"><float name="opacity" value="0.7"/><bsdf type="twosided">'
    '<bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="bump.exr"/>'
    "</texture>{}</bsdf></bsdf></bsdf>",
}
ROOM = """<scene version="3.0.0">
  <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world">
      <lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>
    </transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>
      <rfilter type="box"/></film>
  </sensor>
  <emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>
  {}
</scene>
"""
BALL = '<shape type="sphere">{}</shape>'


def render(scene, spp=64, seed=0):
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3]
