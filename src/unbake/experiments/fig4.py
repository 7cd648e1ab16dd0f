"""Figure 4: the gradients of a roughness in STAIRCASE, and which of them each method misses."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..errors import UserError
from ..imaging.pictures import block_means, false_colour, montage, shrink, tonemap, write_png
from ..io import write_atomically
from ..scene.parse import ParsedScene, parse, referenced
from ..transport.render import render_radiance
from ..transport.vertex import SceneView
from .derivatives import Estimates, estimate
from .experiment import Experiment, ExperimentContext, ExperimentResult, copy_file, save_figure
from .jobs import Findings, Job
from .scenes import STAIRCASE
from .tables import markdown

#: Roughness of the wood of stairs and picture frames: where it is, and where it should be.
VALUES = tuple(round(0.2 + 0.05 * i, 2) for i in range(15))
#: Longest paths of PRB, and differentiable bounces of ours.
CUTS, ATTACHED = (2, 4, 10, 15, 30), (1, 2, 4)
#: The wood's texture: its materials have no names.
WOOD = "WoodPanel"
#: All light, in practice: Russian roulette ends paths before.
MAX_DEPTH = 40
#: By how much the scene's own film is divided for the table's loss, which compares images with the
#: product of an error and a derivative: noise in both fades as pixels get larger.
COARSE = 80
#: Degree of the polynomials over the roughness that stand for the values of a pixel.
DEGREE = 3
#: ε of the relative L2 loss.
EPSILON = 0.01
#: As columns of the figure.
METHODS = (
    "reference",
    "direct",
    *(f"PRB {depth}" for depth in CUTS),
    *(f"ours, k = {k}" for k in ATTACHED),
)
#: The authors' values: method, current and target roughness, gradient.
_PUBLISHED = Path(__file__).parent / "published" / "fig4.csv"


@final
@dataclass(frozen=True)
class _Wood:
    """STAIRCASE, seen as its authors did, and the roughness of its wood."""

    scene_view: SceneView
    rays: CameraRays
    camera: Camera
    assign: Callable[[mi.Float], None]

    @staticmethod
    def of(context: ExperimentContext, shrunk: int) -> _Wood:
        parsed = parse(STAIRCASE.unpacked(context))
        texture, found = mi.load_dict({"type": "uniform", "value": 0.5}), False
        for node in parsed.principled_nodes():
            if WOOD in _picture(parsed, node):
                node.props["roughness"] = texture
                found = True
        if not found:
            raise UserError(f"no material has a texture {WOOD!r}", parsed.path)
        scene = parsed.instantiate()
        parameters = mi.traverse(texture)

        def assign(value: mi.Float) -> None:
            parameters["value"] = value
            parameters.update()

        camera = Camera.from_mitsuba(scene.sensors()[0])
        camera = camera.rescaled(camera.width // shrunk, camera.height // shrunk)
        scene_view = SceneView.of(scene, None, 8)
        return _Wood(scene_view, CameraRays.of([camera]), camera, assign)

    def estimate(self, value: float, spp: int, seed: int) -> Estimates:
        return estimate(
            self.scene_view,
            self.assign,
            value,
            self.rays.through,
            self.rays.pixels,
            spp,
            seed=seed,
            max_depth=MAX_DEPTH,
            cut=CUTS,
            attached=ATTACHED,
        )


def _picture(parsed: ParsedScene, node: object) -> str:
    """The file of a material's albedo, empty if it is no picture."""
    texture = referenced(parsed, node.props["base_color"])
    return "" if texture is None else str(texture.props.get("filename", ""))


# -------------------------------------------------------------------------------------------- jobs


def _jobs(context: ExperimentContext) -> list[Job]:
    STAIRCASE.require(context)
    known = {"max_depth": MAX_DEPTH, "albedo_power": STAIRCASE.albedo_power}
    table = {"shrunk": _shrunk(context), "spp": context.pick(4, 256, 1024)}
    picture = {"shrunk": context.pick(80, 6, 2), "spp": context.pick(4, 64, 1024)}
    picture["zoom"] = context.pick(1, 3, 1)
    jobs = [
        Job(
            _arrays(context, value).stem,
            table | known | {"value": value},
            functools.partial(_at, context, value, **table),
            context.pick(15.0, 32.0, None),
            files=[_arrays(context, value)],
        )
        for value in _values(context)
    ]
    work = functools.partial(_pictures, context, **picture)
    seconds = context.pick(15.0, 60.0, None)
    return [
        *jobs,
        Job("pictures", picture | known, work, seconds, files=[_picture_file(context)]),
    ]


def _shrunk(context: ExperimentContext) -> int:
    """By how much the scene's own film is divided in what is rendered for the table."""
    return context.pick(80, 16, 8)


def _values(context: ExperimentContext) -> tuple[float, ...]:
    return VALUES[::7] if context.scale == "smoke" else VALUES


def _arrays(context: ExperimentContext, value: float) -> Path:
    return context.work / "fig4" / f"value-{value:.2f}.npz"


def _picture_file(context: ExperimentContext) -> Path:
    return context.work / "fig4" / "pictures.png"


def _at(context: ExperimentContext, value: float, shrunk: int, spp: int) -> Findings:
    """Images and derivatives of all methods at one roughness, kept as an array beside the part.

    Two independent passes: an error from one and a derivative from the other make an unbiased
    gradient. The target, from a third one, has no noise in common with either.
    """
    wood = _Wood.of(context, shrunk)
    a, b = (wood.estimate(value, spp, seed) for seed in (1, 2))
    wood.assign(mi.Float(value))
    target = render_radiance(
        wood.scene_view,
        wood.rays.through,
        wood.rays.pixels,
        4 * spp,
        seed=3,
        max_depth=MAX_DEPTH,
        rr_depth=5,
        hide_emitters=False,
    )
    arrays = {"target": target}
    for name, e in (("a", a), ("b", b)):
        for method, (image, derivative) in _methods(e).items():
            arrays[f"{name} {method} image"] = image.astype(np.float32)
            arrays[f"{name} {method} derivative"] = derivative.astype(np.float32)
    file = _arrays(context, value)
    write_atomically(file, lambda path: _save(path, arrays))
    return {"height": wood.camera.height, "width": wood.camera.width}


def _save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    with open(path, "wb") as file:  # numpy would add its own ending to a name
        np.savez(file, **arrays)


def _methods(e: Estimates) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What each method takes for the image, and for its derivative."""
    found = {"reference": (e.image, e.derivative), "direct": e.cut[2]}
    found |= {f"PRB {depth}": e.cut[depth] for depth in CUTS}
    return found | {f"ours, k = {k}": (e.image, e.attached[k]) for k in ATTACHED}


def _pictures(context: ExperimentContext, shrunk: int, spp: int, zoom: int) -> Findings:
    """The first row of the figure: derivatives at a roughness of 0.5."""
    wood = _Wood.of(context, shrunk)
    e = wood.estimate(0.5, spp, 1)
    shape = (wood.camera.height, wood.camera.width, 3)
    found = {m: np.abs(d).mean(-1).reshape(shape[:2]) for m, (_, d) in _methods(e).items()}
    # A few paths of much light would hide all the others: means of small blocks, where there is
    # room for it, and a scale that most pixels of the reference stay below.
    longest = max(shape[:2]) // 2 if context.scale != "smoke" else max(shape[:2])
    found = {method: shrink(picture, longest) for method, picture in found.items()}
    scale = max(float(np.percentile(found["reference"], 95)), 1e-6)
    cells = [shrink(tonemap(e.image.reshape(shape)).astype(float), longest).astype(np.uint8)]
    cells += [false_colour(picture, scale) for picture in found.values()]
    cells = [cell.repeat(zoom, 0).repeat(zoom, 1) for cell in cells]
    half = -(-len(cells) // 2)
    write_png(_picture_file(context), montage([cells[:half], cells[half:]]))
    return {"shown": ["image", *found], "scale": scale}


# ------------------------------------------------------------------------------------------- table


def smoothed(
    arrays: Mapping[float, Mapping[str, np.ndarray]], height: int, width: int, block: int
) -> dict[float, dict[str, np.ndarray]]:
    """Means of blocks of pixels, and polynomials of them over the parameter, evaluated at it.

    Args:
        arrays: by value of the parameter, and by name: shape (height * width, 3).
        block: rows and columns of a block.

    Returns:
        The same, of shape (blocks, 3).
    """
    values = sorted(arrays)
    powers = np.vander(np.array(values) - np.mean(values), min(DEGREE + 1, len(values)))
    onto = powers @ np.linalg.pinv(powers)
    found: dict[float, dict[str, np.ndarray]] = {value: {} for value in values}
    for key in arrays[values[0]]:
        films = (arrays[v][key].astype(np.float64).reshape(height, width, 3) for v in values)
        means = np.stack([block_means(film, block) for film in films])
        for value, fit in zip(values, np.tensordot(onto, means, 1), strict=True):
            found[value][key] = fit.reshape(-1, 3)
    return found


def gradient_table(
    arrays: Mapping[float, Mapping[str, np.ndarray]], method: str
) -> tuple[list[float], np.ndarray]:
    """Gradients of the relative L2 loss by the parameter, (current, target), of a method.

    Args:
        arrays: by value of the parameter, then by name: `target`, and `a` and `b`, the two passes,
            followed by the method and `image` or `derivative`.

    Paper: Eq. 6, Sec. 5.2, 5.4.
    """
    values = sorted(arrays)
    table = np.zeros((len(values), len(values)))
    for i, current in enumerate(values):
        found = arrays[current]
        for j, wanted in enumerate(values):
            target = arrays[wanted]["target"]
            weight = 2 / (target**2 + EPSILON)
            for one, other in ("ab", "ba"):
                error = found[f"{one} {method} image"] - target
                table[i, j] += 0.5 * (weight * error * found[f"{other} {method} derivative"]).mean()
    return values, table


def agreement(values: list[float], table: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """How a table of gradients agrees with the reference.

    Returns:
        relative_rmse: √(mean squared difference / mean squared reference). correlation. slope: of
        the line through zero that fits the table best. sign_agreement: share of entries off the
        diagonal whose signs are the same. diagonal: mean magnitude where current and target are
        equal and there should be no gradient, relative to the root mean square of the reference.
    """
    size = np.sqrt((reference**2).mean())
    off = ~np.eye(len(values), dtype=bool)
    return {
        "relative_rmse": float(np.sqrt(((table - reference) ** 2).mean()) / size),
        "correlation": float(np.corrcoef(table.ravel(), reference.ravel())[0, 1]),
        "slope": float((table * reference).sum() / (reference**2).sum()),
        "sign_agreement": float((np.sign(table) == np.sign(reference))[off].mean()),
        "diagonal": float(np.abs(np.diag(table)).mean() / size),
    }


def published_tables() -> dict[str, tuple[list[float], np.ndarray]]:
    """The tables that the authors published, as `gradient_table` returns them."""
    cells: dict[str, dict[tuple[float, float], float]] = {method: {} for method in METHODS}
    with open(_PUBLISHED, encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            place = float(row["current"]), float(row["target"])
            cells[row["method"]][place] = float(row["gradient"])
    tables = {}
    for method, known in cells.items():
        values = sorted({current for current, _ in known})
        tables[method] = values, np.array([[known[c, t] for t in values] for c in values])
    return tables


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    copy_file(_picture_file(context), context.out / "fig4")
    arrays = {}
    for value in _values(context):
        with np.load(_arrays(context, value)) as file:
            arrays[value] = dict(file)
    film = findings[_arrays(context, _values(context)[0]).stem]
    arrays = smoothed(arrays, film["height"], film["width"], COARSE // _shrunk(context))
    tables = {method: gradient_table(arrays, method) for method in METHODS}
    theirs = published_tables()
    rows, lines = [], []
    for method, (values, table) in tables.items():
        mine = agreement(values, table, tables["reference"][1])
        their = agreement(*theirs[method], theirs["reference"][1])
        rows.append({"method": method} | mine | {f"published_{k}": v for k, v in their.items()})
        digits = {k: 3 if k == "diagonal" else 2 for k in mine}
        told = (f"{mine[k]:.{digits[k]}f} ({their[k]:.{digits[k]}f})" for k in mine)
        lines.append([method, *told])
    titles = ["method", "relative RMSE", "correlation", "slope", "sign agreement", "diagonal"]
    caption = "In brackets: the same of the authors' published table.\n\n"
    everything = [
        {"method": m, "current": c, "target": t, "gradient": float(table[i, j])}
        for m, (values, table) in tables.items()
        for i, c in enumerate(values)
        for j, t in enumerate(values)
    ]
    return ExperimentResult(
        [*rows, *everything],
        caption + markdown(titles, lines),
        lambda path: _draw(path, tables, theirs),
    )


def _draw(path: Path, tables: Mapping, theirs: Mapping) -> None:
    from matplotlib.figure import Figure

    rows = [("here", tables), ("published", theirs)]
    figure = Figure(figsize=(1.5 * len(METHODS), 1.7 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), len(METHODS), squeeze=False)
    for line, (title, shown) in zip(panels, rows, strict=True):
        most = np.abs(shown["reference"][1]).max()
        for panel, method in zip(line, METHODS, strict=True):
            values, table = shown[method]
            edges = (values[0], values[-1], values[0], values[-1])
            panel.imshow(table, cmap="RdBu", vmin=-most, vmax=most, origin="lower", extent=edges)
            panel.set_title(method, fontsize=8)
            panel.tick_params(labelsize=6)
        line[0].set_ylabel(f"{title}\ncurrent", fontsize=7)
    for panel in panels[-1]:
        panel.set_xlabel("target", fontsize=7)
    save_figure(figure, path)


EXPERIMENT = Experiment("fig4", "Gradients of a roughness in STAIRCASE (Fig. 4)", _jobs, _result)
