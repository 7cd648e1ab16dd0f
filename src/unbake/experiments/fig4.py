"""Figure 4: gradients of a roughness in STAIRCASE, as estimated by each method."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, final

import mitsuba as mi
import numpy as np

from ..config import FitConfig, update
from ..dataset.camera import Camera
from ..dataset.camera_files import read_cameras
from ..dataset.pixels import CameraRays
from ..errors import UserError
from ..fields.radiance import RadianceField
from ..imaging.pictures import block_means, false_colour, montage, shrink, tonemap, write_png
from ..io import write_arrays
from ..scene.parse import ParsedScene, parse, referenced
from ..transport.render import render_radiance
from ..transport.vertex import SceneView
from .derivatives import Estimates, estimate
from .experiment import Experiment, ExperimentContext, ExperimentResult, copy_file, save_figure
from .jobs import Findings, Job
from .radiance_cache import CacheTraining, fresh_radiance, load_radiance, save_radiance, train
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
#: The network of L_θ at cpu scale.
RADIANCE = {"learning_rate": 0.008, "grid": {"levels": 7, "table_log2": 16}}
#: Columns of the figure.
METHODS = (
    "reference",
    "direct",
    *(f"PRB {depth}" for depth in CUTS),
    *(f"ours, k = {k}" for k in ATTACHED),
)
#: Ours with the exact radiance in the place of L_θ. Its image is the reference's by construction.
EXACT = tuple(f"exact L, k = {k}" for k in ATTACHED)
#: The roughness with which the training of L_θ begins.
FIRST = 0.55
#: The published values: method, current and target roughness, gradient.
_PUBLISHED = Path(__file__).parent / "published" / "fig4.csv"


@final
@dataclass(frozen=True)
class Wood:
    """STAIRCASE with the camera of its scene file, and the roughness of its wood."""

    scene_view: SceneView
    rays: CameraRays
    camera: Camera
    assign: Callable[[mi.Float], None]

    @staticmethod
    def of(file: Path, shrunk: int) -> Wood:
        """The scene of a file, with a film of 1 / `shrunk` of the resolution.

        Raises:
            UserError: no material has the texture of the wood.
        """
        parsed = parse(file)
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
        return Wood(scene_view, CameraRays.of([camera]), camera, assign)

    def estimate(
        self,
        value: float,
        spp: int,
        seed: int,
        max_depth: int = MAX_DEPTH,
        radiance: RadianceField | None = None,
    ) -> Estimates:
        """Images and derivatives at one roughness."""
        return estimate(
            self.scene_view,
            self.assign,
            value,
            self.rays.through,
            self.rays.pixels,
            spp,
            seed=seed,
            max_depth=max_depth,
            cut=CUTS,
            attached=ATTACHED,
            radiance=radiance,
        )


def _picture(parsed: ParsedScene, node: Any) -> str:
    """The image file of a material's albedo, or an empty string."""
    texture = referenced(parsed, node.props["base_color"])
    return "" if texture is None else str(texture.props.get("filename", ""))


# -------------------------------------------------------------------------------------------- jobs


def _jobs(context: ExperimentContext) -> list[Job]:
    STAIRCASE.require(context)
    known = {"max_depth": MAX_DEPTH, "albedo_power": STAIRCASE.albedo_power}
    table = {"shrunk": _shrunk(context), "spp": context.pick(64, 256, 1024)}
    picture = {"shrunk": context.pick(80, 6, 2), "spp": context.pick(4, 64, 1024)}
    picture["zoom"] = context.pick(1, 3, 1)
    first, each = _trainings(context)
    network = {"radiance": asdict(_settings(context).radiance_settings), "first": FIRST}
    network |= {"training": asdict(first)}
    trained = network | {"further": asdict(each)} | known
    jobs = [
        Job(
            "network",
            network | known,
            functools.partial(_train_first, context),
            context.pick(15.0, 60.0, None),
            files=[_network(context)],
        )
    ]
    jobs += [
        Job(
            _arrays(context, value).stem,
            table | trained | {"value": value},
            functools.partial(_at, context, value, **table),
            context.pick(15.0, 45.0, None),
            files=[_arrays(context, value)],
        )
        for value in _values(context)
    ]
    work = functools.partial(_pictures, context, **picture)
    seconds = context.pick(15.0, 75.0, None)
    return [
        *jobs,
        Job("pictures", picture | trained, work, seconds, files=[_picture_file(context)]),
    ]


def _trainings(context: ExperimentContext) -> tuple[CacheTraining, CacheTraining]:
    """The first training of L_θ, and the further one at each roughness."""
    lanes = context.pick(256, 4096, 16384)
    first = CacheTraining(context.pick(4, 4000, 18000), lanes, 0.008)
    return first, replace(first, steps=context.pick(1, 600, 4000), rate=0.002)


def _settings(context: ExperimentContext) -> FitConfig:
    """The settings of L_θ. There are no photographs here that its size could follow."""
    settings = STAIRCASE.settings(context)
    return update(settings, {"radiance": {"neural": context.pick({}, RADIANCE, {})}})


def _shrunk(context: ExperimentContext) -> int:
    """Resolution of the scene's film over that of the renderings for the table."""
    return context.pick(80, 16, 8)


def _values(context: ExperimentContext) -> tuple[float, ...]:
    return VALUES[::7] if context.scale == "smoke" else VALUES


def _arrays(context: ExperimentContext, value: float) -> Path:
    return context.work / "fig4" / f"value-{value:.2f}.npz"


def _network(context: ExperimentContext) -> Path:
    return context.work / "fig4" / "network.npz"


def _picture_file(context: ExperimentContext) -> Path:
    return context.work / "fig4" / "pictures.png"


def _views(wood: Wood) -> CameraRays:
    """The views from which L_θ is learned: the training views, and the one of the figure."""
    posed = read_cameras(STAIRCASE.cameras, 64, 64)
    return CameraRays.of([*(camera for split, camera in posed if split == "train"), wood.camera])


def _train_first(context: ExperimentContext) -> Findings:
    """Train L_θ at a roughness in the middle."""
    wood = Wood.of(STAIRCASE.unpacked(context), _shrunk(context))
    wood.assign(mi.Float(FIRST))
    config, views = _settings(context), _views(wood)
    radiance = fresh_radiance(wood.scene_view, views, config, 0)
    loss = train(wood.scene_view, radiance, views, _trainings(context)[0], seed=0)
    save_radiance(_network(context), radiance)
    return {"residual": loss}


def _trained(
    context: ExperimentContext, wood: Wood, value: float, config: FitConfig
) -> tuple[RadianceField, float]:
    """L_θ of the scene at one roughness, and its residual."""
    wood.assign(mi.Float(value))
    radiance = load_radiance(_network(context), wood.scene_view, config)
    further = _trainings(context)[1]
    return radiance, train(wood.scene_view, radiance, _views(wood), further, seed=1)


def _at(context: ExperimentContext, value: float, shrunk: int, spp: int) -> Findings:
    """Images and derivatives of all methods at one roughness, kept in a file of arrays."""
    wood = Wood.of(STAIRCASE.unpacked(context), shrunk)
    radiance, loss = _trained(context, wood, value, _settings(context))
    arrays = arrays_at(wood, value, spp, radiance=radiance)
    write_arrays(_arrays(context, value), arrays)
    return {"height": wood.camera.height, "width": wood.camera.width, "residual": loss}


def arrays_at(
    wood: Wood,
    value: float,
    spp: int,
    max_depth: int = MAX_DEPTH,
    radiance: RadianceField | None = None,
) -> dict[str, np.ndarray]:
    """Images and derivatives of all methods at one roughness, as `gradient_table` reads them.

    There are two independent passes: the product of an error from one and a derivative from the
    other is unbiased. What errors are relative to comes from a third one, path traced.

    Args:
        wood: the scene.
        value: roughness.
        spp: samples per pixel of a pass.
        max_depth: maximum path length that counts as all light.
        radiance: L_θ; without it the methods with L_θ are absent.

    Returns:
        By name, each of shape (pixels, 3).
    """
    a, b = (wood.estimate(value, spp, seed, max_depth, radiance) for seed in (1, 2))
    wood.assign(mi.Float(value))
    target = render_radiance(
        wood.scene_view,
        wood.rays.through,
        wood.rays.pixels,
        spp,
        seed=3,
        max_depth=max_depth,
        rr_depth=5,
        hide_emitters=False,
    )
    arrays = {"target": target}
    for name, e in (("a", a), ("b", b)):
        for method, (image, derivative) in _methods(e).items():
            arrays[f"{name} {method} image"] = image.astype(np.float32)
            arrays[f"{name} {method} derivative"] = derivative.astype(np.float32)
    return arrays


def _methods(e: Estimates) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Image and derivative of each method."""
    methods = {"reference": (e.image, e.derivative), "direct": e.cut[2]}
    methods |= {f"PRB {depth}": e.cut[depth] for depth in CUTS}
    methods |= {f"ours, k = {k}": estimates for k, estimates in e.cached.items()}
    return methods | {f"exact L, k = {k}": (e.image, e.attached[k]) for k in ATTACHED}


def _pictures(context: ExperimentContext, shrunk: int, spp: int, zoom: int) -> Findings:
    """The first row of the figure: derivatives at a roughness of 0.5."""
    wood = Wood.of(STAIRCASE.unpacked(context), shrunk)
    radiance, _ = _trained(context, wood, 0.5, _settings(context))
    e = wood.estimate(0.5, spp, 1, radiance=radiance)
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
    arrays: Mapping[float, Mapping[str, np.ndarray]],
    height: int,
    width: int,
    block: int,
    degree: int | None = DEGREE,
) -> dict[float, dict[str, np.ndarray]]:
    """Average blocks of pixels and smooth them by polynomials over the parameter.

    Args:
        arrays: by value of the parameter and by name, each of shape (height * width, 3).
        height: rows of the images.
        width: columns of the images.
        block: size of a block in pixels.
        degree: of the polynomials; None: do not smooth.

    Returns:
        Arrays by the same keys, each of shape (blocks, 3).
    """
    values = sorted(arrays)
    projection = np.eye(len(values))
    if degree is not None:
        powers = np.vander(np.array(values) - np.mean(values), min(degree + 1, len(values)))
        projection = powers @ np.linalg.pinv(powers)
    result: dict[float, dict[str, np.ndarray]] = {value: {} for value in values}
    for key in arrays[values[0]]:
        films = (arrays[v][key].astype(np.float64).reshape(height, width, 3) for v in values)
        means = np.stack([block_means(film, block) for film in films])
        for value, fit in zip(values, np.tensordot(projection, means, 1), strict=True):
            result[value][key] = fit.reshape(-1, 3)
    return result


def gradient_table(
    arrays: Mapping[float, Mapping[str, np.ndarray]],
    method: str,
    *,
    relative: bool = True,
    passes: Sequence[str] = ("ab", "ba"),
) -> tuple[list[float], np.ndarray]:
    """Gradients of the L2 loss by the parameter, as estimated by a method.

    Args:
        arrays: by value of the parameter and by name: `target`, which errors are relative to, and
            for both passes `a METHOD image`, `a METHOD derivative`, `b METHOD image` and `b METHOD
            derivative`. The target of the loss is the image `reference` of the same pass as the
            current image: paths of all values have the same random numbers in it, so that what
            does not depend on the value cancels.
        method: one of `METHODS`.
        relative: whether the loss is the relative one.
        passes: averaged over; of each, the first pass gives the error, the second the derivative.

    Returns:
        The values of the parameter, and an array of gradients, (current, target).

    Paper: Eq. 6, Sec. 5.2, 5.4.
    """
    values = sorted(arrays)
    table = np.zeros((len(values), len(values)))
    for i, current in enumerate(values):
        here = arrays[current]
        for j, aim in enumerate(values):
            target = arrays[aim]["target"]
            weight = 2 / (target**2 + EPSILON) if relative else 2.0
            for one, other in passes:
                error = here[f"{one} {method} image"] - arrays[aim][f"{one} reference image"]
                derivative = here[f"{other} {method} derivative"]
                table[i, j] += (weight * error * derivative).mean() / len(passes)
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


def image_error(arrays: Mapping[float, Mapping[str, np.ndarray]], method: str) -> float:
    """Relative error of a method's images, the root of the mean over pixels and roughnesses.

    The two passes give a factor each, so that noise does not count as an error.
    """
    squares = []
    for here in arrays.values():
        a, b = (here[f"{one} {method} image"] - here[f"{one} reference image"] for one in "ab")
        squares.append((a * b / (here["target"] ** 2 + EPSILON)).mean())
    return float(np.sqrt(max(np.mean(squares), 0.0)))


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    copy_file(_picture_file(context), context.out / "fig4")
    noisy = {}
    for value in _values(context):
        with np.load(_arrays(context, value)) as file:
            noisy[value] = dict(file)
    film = findings[_arrays(context, _values(context)[0]).stem]
    block = COARSE // _shrunk(context)
    arrays = smoothed(noisy, film["height"], film["width"], block)
    single = smoothed(noisy, film["height"], film["width"], block, degree=None)
    tables = {method: gradient_table(arrays, method) for method in (*METHODS, *EXACT)}
    reference = tables["reference"][1]
    published = published_tables()
    rows, lines = [], []
    for method, (values, table) in tables.items():
        here = agreement(values, table, reference)
        # How much is owed to the polynomials.
        unfitted = agreement(*gradient_table(single, method), reference)
        paper = (
            None if method in EXACT else agreement(*published[method], published["reference"][1])
        )
        row = {"method": method} | here | {"image_error": image_error(arrays, method)}
        row |= {f"unfitted_{k}": unfitted[k] for k in ("relative_rmse", "sign_agreement")}
        rows.append(row | {f"published_{k}": v for k, v in (paper or {}).items()})
        digits = {k: 3 if k == "diagonal" else 2 for k in here}
        cells = [f"{here[k]:.{digits[k]}f}" for k in here]
        if paper is not None:
            cells = [
                f"{cell} ({paper[k]:.{digits[k]}f})" for cell, k in zip(cells, here, strict=True)
            ]
        lines.append([method, *cells, f"{100 * row['image_error']:.1f} %"])
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
        caption + markdown([*titles, "error of the image"], lines),
        lambda path: _draw(path, tables, published),
    )


def _draw(path: Path, tables: Mapping, published: Mapping) -> None:
    from matplotlib.figure import Figure

    exact = {f"ours, k = {k}": tables[f"exact L, k = {k}"] for k in ATTACHED}
    rows = [("here", tables), ("here, exact L", exact), ("published", published)]
    figure = Figure(figsize=(1.5 * len(METHODS), 1.7 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), len(METHODS), squeeze=False)
    for line, (title, methods) in zip(panels, rows, strict=True):
        most = np.abs((published if methods is published else tables)["reference"][1]).max()
        shown = [panel for panel, method in zip(line, METHODS, strict=True) if method in methods]
        for panel, method in zip(line, METHODS, strict=True):
            if method not in methods:
                panel.set_axis_off()
                continue
            values, table = methods[method]
            edges = (values[0], values[-1], values[0], values[-1])
            panel.imshow(table, cmap="RdBu", vmin=-most, vmax=most, origin="lower", extent=edges)
            panel.set_title(method, fontsize=8)
            panel.tick_params(labelsize=6)
        shown[0].set_ylabel(f"{title}\ncurrent", fontsize=7)
    for panel in panels[-1]:
        panel.set_xlabel("target", fontsize=7)
    save_figure(figure, path)


EXPERIMENT = Experiment("fig4", "Gradients of a roughness in STAIRCASE (Fig. 4)", _jobs, _result)
