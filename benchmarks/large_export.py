"""What the export of a large room costs: 300 meshes with a million triangles.

    python benchmarks/large_export.py --work FOLDER --out FILE.json [--meshes 300]
        [--triangles 1000000] [--resolution 128] [--steps 10] [--formats gltf] [--real]

The room is made here: walls, a lamp, and boulders in rows. Half of the boulders have texture
coordinates and a material of their own; the others have no coordinates, and share a material five
at a time. A few steps of a fit give fields that differ from place to place; with --real the fit is
that of the defaults, of --steps steps, whose fields have the detail of photographs. The export is a
process of its own; on a machine that is busy with other things its CPU time tells more than the
clock.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import here

import numpy as np

from unbake import backend

backend.activate()

from export_process import export_measured  # noqa: E402

from unbake.experiments.commands import unbake  # noqa: E402
from unbake.exports.tessellate import Triangles  # noqa: E402
from unbake.io import read_object, write_json, write_text  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.scene.triangles import write_mesh  # noqa: E402

SHARED = 5
ROOM = """<scene version="3.0.0">
  <shape type="cube" id="walls"><boolean name="flip_normals" value="true"/>
    <bsdf type="principled" id="paint"/>
    <transform name="to_world"><scale x="6" y="5" z="2"/></transform></shape>
  <shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="180"/>
    <translate z="1.99"/></transform>
    <emitter type="area"><rgb name="radiance" value="12 12 12"/></emitter></shape>
{shapes}
</scene>
"""


def main() -> None:
    """Make the room and a short fit of it, and export that."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="new folder")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--meshes", type=int, default=300)
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--resolution", type=int, default=128, help="of the photographs")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--real", action="store_true", help="a fit of the default settings")
    parser.add_argument("--formats", nargs="+", default=["gltf"])
    args = parser.parse_args()
    data, run, out = (args.work / name for name in ("data", "run", "export"))
    if not data.exists():
        scene = write_room(args.work / "room", args.meshes, args.triangles)
        size = ["--views", 12, "--held-out", 0, "--resolution", args.resolution, "--spp", 4]
        unbake("capture", scene, "--out", data, *size, "--max-depth", 4)
    if not run.exists():
        small = [] if args.real else ["--method", "direct", "--batch", 256, "--spp", 4]
        words = ["--steps", args.steps, *small]
        unbake("fit", data, "--out", run, *words)
    cost = export_measured(run, out, "--format", *args.formats)
    manifest = read_object(out / "export.json")
    rows = manifest["materials"]
    found = {
        "machine": machine(),
        "formats": args.formats,
        "parts": len(manifest["parts"]),
        "triangles": sum(part["triangles"] for part in manifest["parts"]),
        "materials": len(rows),
        "own_coordinates": sum(row["coordinates"] == "own" for row in rows),
        "unwrapping": {row["name"]: row["coordinates"] for row in rows},
        "steps": manifest["run"]["steps"],
        "megatexels": sum(row["resolution"] ** 2 for row in rows) / 1e6,
        "near": manifest["near"],
        "cost": cost,
        "out_mb": round(sum(f.stat().st_size for f in out.rglob("*") if f.is_file()) / 1e6, 1),
    }
    write_json(args.out, found, allow_nan=False)
    print(found, flush=True)


def write_room(folder: Path, meshes: int, triangles: int) -> Path:
    """Write the scene; returns its file."""
    along = round((triangles / meshes / 2) ** 0.5)
    columns = round((meshes * 1.3) ** 0.5)
    shapes = []
    for i in range(meshes):
        x, y = i % columns, i // columns
        centre = 10.4 * (x + 0.5) / columns - 5.2, 8.4 * (y + 0.5) / (meshes / columns) - 4.2
        own = i % 2 == 0
        file = folder / "meshes" / f"boulder-{i}.ply"
        stone = boulder(i, (*centre, -1.5 + 0.5 * (i % 3)), 0.17, along, own)
        write_mesh(file, *stone.arrays)
        material = f"own-{i}" if own else f"shared-{i // (2 * SHARED)}"
        shapes.append(
            f'  <shape type="ply" id="boulder-{i}"><string name="filename" '
            f'value="meshes/{file.name}"/><ref id="{material}"/></shape>'
        )
    names = sorted({shape.split('ref id="')[1].split('"')[0] for shape in shapes})
    bsdfs = [f'  <bsdf type="principled" id="{name}"/>' for name in names]
    write_text(folder / "scene.xml", ROOM.format(shapes="\n".join([*bsdfs, *shapes])))
    return folder / "scene.xml"


def boulder(
    seed: int, centre: tuple[float, ...], radius: float, along: int, coordinates: bool
) -> Triangles:
    """A ball with waves in it, of 2 along² triangles or a few less."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(along + 1) / along, np.arange(along + 1) / along)
    θ, φ = np.pi * (0.02 + 0.96 * v.ravel()), 2 * np.pi * u.ravel()
    d = np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), np.cos(θ)], -1)
    waves = rng.normal(size=(6, 3)) * 4
    r = radius * (1 + 0.06 * np.sin(d @ waves.T + rng.uniform(0, 6, 6)).sum(1))
    first = (np.arange(along)[:, None] * (along + 1) + np.arange(along)).ravel()
    a, b, c, e = (first + k for k in (0, 1, along + 1, along + 2))
    faces = np.concatenate([np.stack([a, c, e], -1), np.stack([a, e, b], -1)])
    uv = np.stack([u.ravel(), v.ravel()], -1).astype(np.float32) if coordinates else None
    positions = (np.array(centre) + r[:, None] * d).astype(np.float32)
    return Triangles(positions, faces.astype(np.uint32), None, uv)


if __name__ == "__main__":
    main()
