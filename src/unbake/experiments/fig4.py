"""Figure 4: gradients of a roughness in STAIRCASE, as estimated by each method."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

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

#: Current and target roughness of the wood of stairs and picture frames.
VALUES = tuple(round(0.2 + 0.05 * i, 2) for i in range(15))
#: Maximum path lengths of PRB, and numbers of differentiable bounces of ours.
CUTS, ATTACHED = (2, 4, 10, 15, 30), (1, 2, 4)
#: The texture of the wood, which identifies its materials: they have no names.
WOOD = "WoodPanel"
#: Practically all light: Russian roulette ends paths earlier.
MAX_DEPTH = 40
#: Resolution of the scene's film over that of the table's loss. A gradient is the product of an
#: error and a derivative; larger pixels reduce the noise of both.
COARSE = 80
#: Degree of the polynomials that are fitted to the values of a pixel over the roughness.
DEGREE = 3
#: ε of the relative L2 loss.
EPSILON = 0.01
#: Columns of the figure.
METHODS = (
    "reference",
    "direct",
    *(f"PRB {depth}" for depth in CUTS),
    *(f"ours, k = {k}" for k in ATTACHED),
)
#: The published values: method, current and target roughness, gradient.
_PUBLISHED = Path(__file__).parent / "published" / "fig4.csv"


@final
@dataclass(frozen=True)
class _Wood:
    """STAIRCASE with the camera of its scene file, and the roughness of its wood."""

    scene_view: SceneView
    rays: CameraRays
    camera: Camera
    assign: Callable[[mi.Float], None]

    @staticmethod
    def of(context: ExperimentContext, shrunk: int) -> _Wood:
        parsed = parse(STAIRCASE.unpacked(context))
        texture, present = mi.load_dict({"type": "uniform", "value": 0.5}), False
        for node in parsed.principled_nodes():
            if WOOD in _picture(parsed, node):
                node.props["roughness"] = texture
                present = True
        if not present:
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


def _picture(parsed: ParsedScene, node: Any) -> str:
    """The image file of a material's albedo, or an empty string."""
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
    """Resolution of the scene's film over that of the renderings for the table."""
    return context.pick(80, 16, 8)


def _values(context: ExperimentContext) -> tuple[float, ...]:
    return VALUES[::7] if context.scale == "smoke" else VALUES


def _arrays(context: ExperimentContext, value: float) -> Path:
    return context.work / "fig4" / f"value-{value:.2f}.npz"


def _picture_file(context: ExperimentContext) -> Path:
    return context.work / "fig4" / "pictures.png"


def _at(context: ExperimentContext, value: float, shrunk: int, spp: int) -> Findings:
    """Images and derivatives of all methods at one roughness, kept in a file of arrays.

    There are two independent passes: the product of an error from one and a derivative from the
    other is unbiased. The target comes from a third pass, independent of both.
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
    with open(path, "wb") as file:  # np.savez appends .npz to names
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def _methods(e: Estimates) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Image and derivative of each method."""
    methods = {"reference": (e.image, e.derivative), "direct": e.cut[2]}
    methods |= {f"PRB {depth}": e.cut[depth] for depth in CUTS}
    return methods | {f"ours, k = {k}": (e.image, e.attached[k]) for k in ATTACHED}


def _pictures(context: ExperimentContext, shrunk: int, spp: int, zoom: int) -> Findings:
    """The first row of the figure: derivatives at a roughness of 0.5."""
    wood = _Wood.of(context, shrunk)
    e = wood.estimate(0.5, spp, 1)
    shape = (wood.camera.height, wood.camera.width, 3)
    pictures = {m: np.abs(d).mean(-1).reshape(shape[:2]) for m, (_, d) in _methods(e).items()}
    # Averages over blocks and a scale that most of the reference stays below: a few paths with a
    # large contribution would hide all others.
    longest = max(shape[:2]) // 2 if context.scale != "smoke" else max(shape[:2])
    pictures = {method: shrink(picture, longest) for method, picture in pictures.items()}
    scale = max(float(np.percentile(pictures["reference"], 95)), 1e-6)
    cells = [shrink(tonemap(e.image.reshape(shape)).astype(float), longest).astype(np.uint8)]
    cells += [false_colour(picture, scale) for picture in pictures.values()]
    cells = [cell.repeat(zoom, 0).repeat(zoom, 1) for cell in cells]
    half = -(-len(cells) // 2)
    write_png(_picture_file(context), montage([cells[:half], cells[half:]]))
    return {"shown": ["image", *pictures], "scale": scale}


# ------------------------------------------------------------------------------------------- table


def smoothed(
    arrays: Mapping[float, Mapping[str, np.ndarray]], height: int, width: int, block: int
) -> dict[float, dict[str, np.ndarray]]:
    """Average blocks of pixels and smooth them by polynomials over the parameter.

    Args:
        arrays: by value of the parameter and by name, each of shape (height * width, 3).
        height: rows of the images.
        width: columns of the images.
        block: size of a block in pixels.

    Returns:
        Arrays by the same keys, each of shape (blocks, 3).
    """
    values = sorted(arrays)
    powers = np.vander(np.array(values) - np.mean(values), min(DEGREE + 1, len(values)))
    projection = powers @ np.linalg.pinv(powers)
    result: dict[float, dict[str, np.ndarray]] = {value: {} for value in values}
    for key in arrays[values[0]]:
        films = (arrays[v][key].astype(np.float64).reshape(height, width, 3) for v in values)
        means = np.stack([block_means(film, block) for film in films])
        for value, fit in zip(values, np.tensordot(projection, means, 1), strict=True):
            result[value][key] = fit.reshape(-1, 3)
    return result


def gradient_table(
    arrays: Mapping[float, Mapping[str, np.ndarray]], method: str
) -> tuple[list[float], np.ndarray]:
    """Gradients of the relative L2 loss by the parameter, as estimated by a method.

    Args:
        arrays: by value of the parameter and by name: `target`, and for both passes `a METHOD
            image`, `a METHOD derivative`, `b METHOD image` and `b METHOD derivative`.
        method: one of `METHODS`.

    Returns:
        The values of the parameter, and an array of gradients, (current, target).

    Paper: Eq. 6, Sec. 5.2, 5.4.
    """
    values = sorted(arrays)
    table = np.zeros((len(values), len(values)))
    for i, current in enumerate(values):
        passes = arrays[current]
        for j, aim in enumerate(values):
            target = arrays[aim]["target"]
            weight = 2 / (target**2 + EPSILON)
            for one, other in ("ab", "ba"):
                error = passes[f"{one} {method} image"] - target
                table[i, j] += (
                    0.5 * (weight * error * passes[f"{other} {method} derivative"]).mean()
                )
    return values, table


def agreement(values: list[float], table: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """How well a table of gradients agrees with the reference.

    Returns:
        `relative_rmse`: √(mean squared difference / mean squared reference); `correlation`;
        `slope` of the line through zero that fits the table best; `sign_agreement`: fraction of
        entries off the diagonal with equal signs; `diagonal`: mean magnitude where current and
        target are equal and the gradient should be zero, over the root mean square of the
        reference.
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
    """The published tables by method, in the form of `gradient_table`."""
    cells: dict[str, dict[tuple[float, float], float]] = {method: {} for method in METHODS}
    with open(_PUBLISHED, encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            place = float(row["current"]), float(row["target"])
            cells[row["method"]][place] = float(row["gradient"])
    tables = {}
    for method, gradients in cells.items():
        values = sorted({current for current, _ in gradients})
        tables[method] = values, np.array([[gradients[c, t] for t in values] for c in values])
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
    published = published_tables()
    rows, lines = [], []
    for method, (values, table) in tables.items():
        here = agreement(values, table, tables["reference"][1])
        paper = agreement(*published[method], published["reference"][1])
        rows.append({"method": method} | here | {f"published_{k}": v for k, v in paper.items()})
        digits = {k: 3 if k == "diagonal" else 2 for k in here}
        cells = (f"{here[k]:.{digits[k]}f} ({paper[k]:.{digits[k]}f})" for k in here)
        lines.append([method, *cells])
    titles = ["method", "relative RMSE", "correlation", "slope", "sign agreement", "diagonal"]
    caption = "In brackets: the same for the published table.\n\n"
    gradients = [
        {"method": m, "current": c, "target": t, "gradient": float(table[i, j])}
        for m, (values, table) in tables.items()
        for i, c in enumerate(values)
        for j, t in enumerate(values)
    ]
    return ExperimentResult(
        [*rows, *gradients],
        caption + markdown(titles, lines),
        lambda path: _draw(path, tables, published),
    )


def _draw(path: Path, tables: Mapping, published: Mapping) -> None:
    from matplotlib.figure import Figure

    rows = [("here", tables), ("published", published)]
    figure = Figure(figsize=(1.5 * len(METHODS), 1.7 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), len(METHODS), squeeze=False)
    for line, (title, methods) in zip(panels, rows, strict=True):
        most = np.abs(methods["reference"][1]).max()
        for panel, method in zip(line, METHODS, strict=True):
            values, table = methods[method]
            edges = (values[0], values[-1], values[0], values[-1])
            panel.imshow(table, cmap="RdBu", vmin=-most, vmax=most, origin="lower", extent=edges)
            panel.set_title(method, fontsize=8)
            panel.tick_params(labelsize=6)
        line[0].set_ylabel(f"{title}\ncurrent", fontsize=7)
    for panel in panels[-1]:
        panel.set_xlabel("target", fontsize=7)
    save_figure(figure, path)


EXPERIMENT = Experiment("fig4", "Gradients of a roughness in STAIRCASE (Fig. 4)", _jobs, _result)
