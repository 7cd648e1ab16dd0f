"""Scores of recovered lighting: the environment map, balls relit by it, and emitter strengths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.lighting import true_emission
from ..fields.envmap import solid_angles
from ..imaging.metrics import psnr
from ..training.problem import Problem

#: Degree of the spherical harmonics: rougher surfaces than mirrors respond to little beyond it.
ORDER = 3
RELIT_HEIGHT = 40
RELIT_SAMPLES = 256
#: Smallest norm that an error is relative to.
DARK = 1e-9

DEFINITIONS = {
    "sh_error": f"|c - c*| / |c*|, c the spherical harmonics coefficients of the map up to order "
    f"{ORDER}, all channels together",
    "relight_psnr": "PSNR, peak 1, of a picture of a white, a grey glossy and a metal ball side by "
    "side lit by the recovered and by the true map (path traced, linear RGB, same seed), over the "
    "pixels that see a ball; both divided by the 99th percentile of the true picture and clipped "
    "to [0,1]",
    "aligned": "the same after each channel of the recovered map has been multiplied by the number "
    "that brings its coefficients nearest to the true ones in the least squares sense",
    "sh_error_seen": "the same, with the true map in directions from which no light reaches what "
    "training views show",
    "relight_psnr_seen": "the same of the picture",
    "environment_seen_share": "share of all directions from which light reaches surfaces "
    "that training views show, or from which they show the environment itself",
    "emission_error": "|c - c*| / |c*| of a light's radiance, RGB; none of a light that is black",
}


@dataclass(frozen=True)
class RecoveredEmitter:
    """An emitter whose strength was optimized, and its relative error.

    There is no error where the truth is not known or black.
    """

    name: str
    strength: list[float]  # linear RGB
    truth: list[float] | None
    emission_error: float | None


def recovered_emitters(
    problem: Problem, data: Path, *, allow_outside: bool = False
) -> list[RecoveredEmitter]:
    """The emitters' strengths beside the true ones of the data set, where those are known.

    Args:
        problem: the fit.
        data: the data set's folder.
        allow_outside: follow a link out of the folder.

    Raises:
        UserError: the data set's truth cannot be read.
    """
    if problem.emission is None:
        return []
    known = true_emission(data, allow_outside=allow_outside)
    found = np.array(problem.emission.values).T
    recovered = []
    for name, strength in zip(problem.emitter_names, found, strict=True):
        truth, error = known.get(name), None
        if truth is not None and np.linalg.norm(truth) > DARK:
            error = _relative_error(strength, truth)
        true = None if truth is None else truth.tolist()
        recovered.append(RecoveredEmitter(name, [float(x) for x in strength], true, error))
    return recovered


def compare_environments(
    found: np.ndarray, truth: np.ndarray, seen: np.ndarray | None = None
) -> dict:
    """Errors of a map against the true one, as it is and with its scale aligned.

    Args:
        found, truth: linear RGB radiance in the layout of `latlong`, shape (h, 2 h, 3).
        seen: the directions that tell of it, shape (h, 2 h); None: they are not asked for.

    Returns:
        Scores by their names in `DEFINITIONS`.

    Paper: Sec. 6.4, Fig. 8.
    """
    aligned, of_seen = found * environment_scale(found, truth), {}
    if seen is not None:
        mixed = np.where(seen[..., None], found, truth)
        of_seen = {
            "sh_error_seen": sh_error(mixed, truth),
            "relight_psnr_seen": relight_psnr(mixed, truth),
        }
    return of_seen | {
        "sh_error": sh_error(found, truth),
        "sh_error_aligned": sh_error(aligned, truth),
        "relight_psnr": relight_psnr(found, truth),
        "relight_psnr_aligned": relight_psnr(aligned, truth),
    }


def environment_scale(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Factors (3,), one a channel, that fit a map to the truth: least squares of coefficients."""
    c, true = sh_coefficients(found), sh_coefficients(truth)
    return (c * true).sum(0) / np.maximum((c * c).sum(0), DARK)


def sh_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Relative error of the low frequencies of a map; see `DEFINITIONS`."""
    return _relative_error(sh_coefficients(found), sh_coefficients(truth))


def sh_coefficients(image: np.ndarray) -> np.ndarray:
    """Real spherical harmonics coefficients of a map, ((ORDER + 1)², 3), m from -l to l.

    θ is measured from the image's top, φ from its left edge; no Condon–Shortley phase.
    """
    weighted = image * solid_angles(len(image))[..., None]
    return np.einsum("khw,hwc->kc", _sh_basis(len(image)), weighted)


def relight_psnr(found: np.ndarray, truth: np.ndarray) -> float:
    """PSNR in dB of balls lit by a map and by the true one; see `DEFINITIONS`."""
    true, seen = relit(truth)
    white = max(float(np.percentile(true[seen], 99)), DARK)
    ours, theirs = (np.clip(picture / white, 0, 1) for picture in (relit(found)[0], true))
    return psnr(ours, theirs, seen)


def relit(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Render three balls, lit by a map alone.

    Returns:
        Linear RGB, shape (RELIT_HEIGHT, 3 RELIT_HEIGHT, 3), and the mask of the balls.
    """
    materials = [
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
        {"type": "principled", "base_color": {"type": "rgb", "value": 0.4}, "roughness": 0.3},
        {"type": "roughconductor", "alpha": 0.2},
    ]
    scene = {
        "type": "scene",
        "light": {"type": "envmap", "bitmap": mi.Bitmap(picture.astype(np.float32))},
    }
    for i, material in enumerate(materials):
        ball = {"type": "sphere", "center": [2.2 * (i - 1), 0, 0], "bsdf": material}
        scene[f"ball{i}"] = ball
    film = {
        "type": "hdrfilm",
        "width": 3 * RELIT_HEIGHT,
        "height": RELIT_HEIGHT,
        "pixel_format": "rgba",
        "rfilter": {"type": "box"},
    }
    away = mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "fov": 19, "to_world": away, "film": film})
    path = mi.load_dict({"type": "path", "max_depth": 6, "hide_emitters": True})
    image = np.array(mi.render(mi.load_dict(scene), None, sensor, path, spp=RELIT_SAMPLES, seed=0))
    return image[..., :3], image[..., 3] > 0.999


def _relative_error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / max(np.linalg.norm(truth), DARK))


def _sh_basis(rows: int) -> np.ndarray:
    """The basis functions at a map's texels, ((ORDER + 1)², rows, 2 rows), float64."""
    θ, φ = np.meshgrid(
        np.pi * np.arange(rows) / (rows - 1),
        np.pi * (np.arange(2 * rows) + 0.5) / rows,
        indexing="ij",
    )
    # `dr.sh_eval` includes the Condon–Shortley phase (-1)^m. Half a turn about z removes it.
    d = np.stack([-np.sin(θ) * np.cos(φ), -np.sin(θ) * np.sin(φ), np.cos(θ)])
    basis = dr.sh_eval(dr.float64_array_t(mi.Vector3f)(d.reshape(3, -1)), ORDER)
    # The constant function comes as a single number.
    return np.reshape([np.broadcast_to(f, θ.size) for f in basis], (-1, *θ.shape))
