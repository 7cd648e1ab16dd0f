"""Table 2: the length of paths in a closed cube."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..acquisition.built_in import default_cameras, write_scene
from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..scene.parse import parse
from ..transport.path_tracer import path_lengths
from ..transport.render import parts_of
from ..transport.vertex import SceneView
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .tables import markdown

#: By albedo: maximum and mean path length in the paper.
PUBLISHED = {
    0.3: (5, 1.43),
    0.5: (7, 1.98),
    0.7: (13, 3.30),
    0.9: (42, 9.89),
    0.95: (84, 19.76),
    0.97: (140, 32.89),
}
#: A maximum path length that no path reaches.
ENDLESS = 4096


def _jobs(context: ExperimentContext) -> list[Job]:
    pixels, spp = context.pick((8, 32), (32, 64), (128, 64))
    return [
        Job(
            f"albedo-{albedo}",
            {"albedo": albedo, "pixels": pixels, "spp": spp},
            lambda albedo=albedo: _measure(context.work / "scenes", albedo, pixels, spp),
            context.pick(0.5, 1.5, None),
            group=str(albedo),
        )
        for albedo in PUBLISHED
    ]


def _measure(folder: Path, albedo: float, pixels: int, spp: int) -> Findings:
    """Path lengths if Russian roulette ends paths with the absorption of the walls."""
    scene = parse(write_scene("cube", folder / f"cube-{albedo}", albedo=albedo)).instantiate()
    scene_view = SceneView.of(scene, None, 0)
    cameras = [
        Camera.look_at(c["origin"], c["target"], c["up"], c["fov"], pixels, pixels)
        for c in default_cameras("cube", 8, 0)
    ]
    rays = CameraRays.of(cameras)
    limit, _ = PUBLISHED[albedo]
    findings: Findings = {"limit": limit}
    for name, most in (("limited", limit), ("endless", ENDLESS)):
        lengths = [
            np.array(path_lengths(scene_view, ray, seed, max_depth=most, rr_depth=2))
            for _, ray, seed in parts_of(rays.through, rays.pixels, spp, 0)
        ]
        findings[name] = float(np.concatenate(lengths).mean(dtype=np.float64))
    return findings


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    rows = []
    for albedo, (limit, mean) in PUBLISHED.items():
        measured = findings[f"albedo-{albedo}"]
        rows.append(
            {
                "albedo": albedo,
                "limit": limit,
                "published": mean,
                "mean": measured["limited"],
                "expected": (1 - albedo**limit) / (1 - albedo),
                "mean_without_limit": measured["endless"],
                "expected_without_limit": 1 / (1 - albedo),
            }
        )
    titles = ["albedo", "limit", "the paper", "mean", "(1 − ρⁿ) / (1 − ρ)"]
    table = markdown(
        [*titles, "mean, no limit", "1 / (1 − ρ)"],
        [[r["albedo"], r["limit"], *(f"{x:.2f}" for x in list(r.values())[2:])] for r in rows],
    )
    return ExperimentResult(rows, table)


EXPERIMENT = Experiment("table2", "Lengths of paths in the cube (Table 2)", _jobs, _result)
