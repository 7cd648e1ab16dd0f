"""What holds a fit's roughness back: one part after the other is replaced by the truth.

    python benchmarks/roughness_limits.py --runs RUN [RUN ...] [--pixels 262144] [--spp 16]
        --out FILE.json

The roughness of pixels that searches see is compared with their true one:

- as it was fitted, and with the network's part replaced by its mean in each piece and colour;
- with the tables of pieces and colours fitted to the true roughness, and with all numbers so:
  what tables, and the whole field, can represent;
- after one more search of all these samples with the default settings, after the same with a
  descent that goes on to its optimum, and as the mean of four searches of a quarter each;
- after a search of made-up photographs of the true materials under the run's own radiance field,
  so that L_theta is exact; without noise, and with that of the photographs;
- after such a search whose samples are those of the made-up photographs, so that they have no
  noise, either: with the fitted albedo, and with the true one.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import here

import numpy as np
from roughness_curves import numbers_of, opened

from unbake import backend
from unbake.config import RoughnessSearchConfig
from unbake.io import write_json
from unbake.machine import machine

#: Camera samples that are traced at once, for the largest number of them a pixel.
AT_ONCE = 1 << 18
#: Samples of made-up photographs, as a multiple of those that a search compares with them.
CLEANER = 2
#: The rate of a descent that reaches its optimum in as many steps, as a multiple of the usual one.
TO_OPTIMUM = 10.0
#: Searches whose mean is compared with one of all their samples.
PARTS = 4
#: Steps towards the truth, their rate, and the part of it that is left at the end.
STEPS, RATE, FINAL_RATE = 400, 0.02, 0.03
#: The rate of numbers of the network, as a part of that of the tables.
NETWORK_RATE = 0.25
#: Factors of albedo that lead to the true one are no larger.
LARGEST_FACTOR = 3.0
#: Bins of a channel of albedo, in which the network's part is averaged.
COLOURS = 6


def main() -> None:
    """Take runs apart, and tell the PSNR of each variant."""
    told_of_runs(__doc__.splitlines()[0], limits_of, 1 << 18, 16)


def told_of_runs(
    description: str, tell: Callable[[Path, int, int], dict[str, Any]], pixels: int, spp: int
) -> None:
    """Write what is told of each run that the command line names.

    Args:
        description: of the command.
        tell: of a run's folder, pixels and samples of each.
        pixels, spp: where the command line does not say.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="folders of fits")
    parser.add_argument("--pixels", type=int, default=pixels)
    parser.add_argument("--spp", type=int, default=spp)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    found = [tell(run, args.pixels, args.spp) for run in args.runs]
    write_json(args.out, {"machine": machine(), "spp": args.spp, "rows": found})


def print_scores(name: str, scores: dict[str, float]) -> None:
    """Print PSNRs in dB of a data set, a line each."""
    for key, value in scores.items():
        print(f"{name}: {key}: {value:.2f} dB", flush=True)


def limits_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The PSNRs of a run's variants in dB, by name, and what the run is.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.roughness_curves import precision

    run, steps = opened(folder)
    (rows, many), true = sampled(run, pixels, (spp, CLEANER * spp))
    roughness, albedo = true[:, 0], true[:, 1:]
    shared = Shared(run, rows, roughness)
    told = {
        "as fitted": shared.score({}),
        "network by its means": psnr(shared.without_network(), roughness),
        "tables at the truth": shared.score(shared.towards_truth(shared.field.shared())),
        "all at the truth": shared.score(shared.towards_truth(shared.fitted)),
    }
    weight = rows["weight"].copy()
    rows["weight"] = weight * precision(rows, shared.values)
    parts = [shared.searched(part) for part in np.array_split(rows, PARTS)]
    mean = {key: sum(part[key] for part in parts) / PARTS for key in parts[0]}
    told |= {
        "one search": shared.score(shared.searched(rows)),
        "to the optimum": shared.score(shared.searched(rows, TO_OPTIMUM)),
        "searches": shared.score(mean),
    }
    clean = made_up(many, roughness, albedo)
    deviation = 1 / np.sqrt(np.maximum(rows["weight"], 1e-12))
    noisy = clean + deviation * np.random.default_rng(0).standard_normal(clean.shape)
    for name, target in (("made-up and noisy", noisy), ("made-up photographs", clean)):
        rows["target"] = target
        rows["weight"] = weight * precision(rows, roughness)
        told[name] = shared.score(shared.searched(rows))
    for name, known in (("no noise at all", rows), ("and true albedo", recoloured(rows, albedo))):
        exact = without_noise(known)
        exact["target"] = made_up(exact, roughness, albedo)
        told[name] = shared.score(shared.searched(exact))
    name = run.dataset.folder.name
    print_scores(name, told)
    about = {"data": name, "steps": steps, "pixels": len(rows)}
    return about | {"roughness_psnr": told}


def sampled(
    run: Any, pixels: int, spps: Sequence[int], first: int = 0
) -> tuple[list[np.ndarray], np.ndarray]:
    """Rows of the same pixels from several numbers of samples, and their true materials.

    Args:
        run: whose fields are those of its checkpoint.
        pixels: how many are sampled; those that searches cannot use are left out.
        spps: camera samples of each pixel.
        first: number of the first batch; batches of other numbers have other random numbers.

    Returns:
        An array of `row_type` for each of `spps`, shape (n,), and roughness and albedo, shape
        (n, 4).
    """
    from unbake.training.problem import pixels_of
    from unbake.training.roughness_curves import NODES
    from unbake.training.search_samples import SearchSamples
    from unbake.training.step import TrainingStep, without_garbage_collection
    from unbake.training.truth_fit import TrueMaps

    photographs = pixels_of(run.dataset, run.config, clip_negative=run.clip_negative)
    samples = SearchSamples(run.problem, TrainingStep(run.problem, photographs, run.config))
    table = photographs.photographs.table[:, :3]
    maps = TrueMaps.load(run.dataset, ("roughness", "albedo"))
    truth = np.full((len(table), 4), np.nan, np.float32)
    truth[maps.numbers] = maps.values

    each = min(pixels, AT_ONCE // max(spps))

    def sample(number: int) -> list[np.ndarray]:
        with without_garbage_collection():
            found = [
                samples.by_roughness(run.state, (number, 2 * number + i), each, count, NODES)
                for i, count in enumerate(spps)
            ]
        kinds = [numbers_of(rows["target"], table) for rows in found]
        same = functools.reduce(np.intersect1d, kinds, kinds[0])
        chosen = [np.unique(kind, return_index=True) for kind in kinds]
        rows = [r[i[np.isin(k, same)]] for r, (k, i) in zip(found, chosen, strict=True)]
        return [*rows, truth[same]]

    batches = [sample(first + number) for number in range(-(-pixels // each))]
    *rows, true = (np.concatenate(part) for part in zip(*batches, strict=True))
    known = np.isfinite(true).all(1)
    return [part[known] for part in rows], true[known]


class Shared:
    """The numbers that points share in a run's field of roughness, and others in their place.

    Args:
        run: whose fields are those of its checkpoint.
        rows: of `row_type`.
        truth: roughness of these pixels, shape (n,).
    """

    def __init__(self, run: Any, rows: np.ndarray, truth: np.ndarray) -> None:
        import drjit as dr

        from unbake.training.roughness_curves import points

        self.field = run.problem.materials["roughness"]
        self._rows, self._truth, self._point = rows, truth, points(rows, albedo=True)
        # Pieces stay where they are most probable.
        self._settings = RoughnessSearchConfig(pixels_as_one=0)
        self._rate = run.config.material_settings["roughness"].learning_rate * self._settings.rate
        parameters = self.field.parameters()
        self.fitted = {key: type(x)(dr.detach(x)) for key, x in parameters.items()}
        self.values = self._values().numpy()

    def _values(self) -> Any:
        from unbake.training.roughness_curves import roughness_of

        return roughness_of(self.field, self._point)

    def values_with(self, changed: dict[str, Any]) -> np.ndarray:
        """Roughness with some numbers changed, shape (n,)."""
        self.field.assign(self.fitted | changed)
        found = self._values().numpy()
        self.field.assign(self.fitted)
        return found

    def score(self, changed: dict[str, Any]) -> float:
        """The PSNR with some numbers changed."""
        return psnr(self.values_with(changed), self._truth)

    def towards_truth(self, names: Iterable[str]) -> dict[str, Any]:
        """Some of the numbers, fitted to the true roughness."""
        import drjit as dr
        import mitsuba as mi

        from unbake.fields.arrays import from_numpy

        optimizer = mi.ad.Adam(RATE, {key: self.fitted[key] for key in names})
        shared, goal = self.field.shared(), from_numpy(mi.Float, self._truth)
        for number in range(STEPS):
            now = RATE * FINAL_RATE ** (number / STEPS)
            rates = {key: now if key in shared else NETWORK_RATE * now for key in optimizer}
            optimizer.set_learning_rate({key: dr.opaque(mi.Float, r) for key, r in rates.items()})
            self.field.assign(self.fitted | dict(optimizer.items()))
            dr.backward(dr.mean(dr.square(self._values() - goal)))
            optimizer.step()
        self.field.assign(self.fitted)
        return {key: dr.detach(x) for key, x in optimizer.items()}

    def searched(
        self,
        rows: np.ndarray,
        faster: float = 1,
        settings: RoughnessSearchConfig | None = None,
        *,
        places: bool = False,
    ) -> dict[str, Any]:
        """What a search finds; the variance of errors, times weight, is 1.

        Args:
            rows: of `row_type`.
            faster: the rate of its descent, as a multiple of the usual one.
            settings: None: the default ones, but that pieces stay where they are most probable.
            places: whether what differs from place to place is sought, too; not without settings.
        """
        from unbake.training.roughness_curves import Curves
        from unbake.training.roughness_search import searched

        settings = settings or self._settings
        curves = Curves.of(rows, settings.cells, settings.colours, albedo=True)
        of_places = rows if places else None
        found = searched(self.field, curves, settings, faster * self._rate, rows=of_places)
        self.field.assign(self.fitted)
        return found

    def without_network(self) -> np.ndarray:
        """Values with what the network adds replaced by its mean in each piece and colour."""
        tables = self.field.pieces.evaluate(self._point)[0].numpy()
        network = outputs_at(self.values) - tables
        group = numbered(self._rows["piece"][:, None], colours_of(self._rows))
        return roughness_at(tables + means_of(network, group))


def in_units_of_variance(
    folder: Path, pixels: int, spp: int
) -> tuple[Any, int, np.ndarray, np.ndarray, Shared]:
    """A run and its steps, rows in units of their variance, true roughness, and shared numbers.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.roughness_curves import precision

    run, steps = opened(folder)
    (rows,), true = sampled(run, pixels, (spp,))
    shared = Shared(run, rows, true[:, 0])
    rows["weight"] *= precision(rows, shared.values)
    return run, steps, rows, true[:, 0], shared


def outputs_at(roughness: np.ndarray) -> np.ndarray:
    """Outputs of the field before their bounds; the same shape."""
    from unbake.training.roughness_curves import of_roughness
    from unbake.training.seen_pieces import outputs_of

    return outputs_of(of_roughness(roughness))


def roughness_at(outputs: np.ndarray) -> np.ndarray:
    """Roughness of outputs of the field before their bounds; the same shape."""
    from unbake.quantities import QUANTITIES
    from unbake.training.seen_pieces import values_of

    quantity = QUANTITIES["roughness"]
    return quantity.lower + (quantity.upper - quantity.lower) * values_of(outputs)


def colours_of(rows: np.ndarray) -> np.ndarray:
    """The colour of the albedo of each pixel, from 0 along each channel, shape (n, 3)."""
    bright = np.sqrt(np.clip(rows["albedo"], 0, 1))
    return np.minimum(np.floor(bright * COLOURS), COLOURS - 1)


def numbered(*columns: np.ndarray) -> np.ndarray:
    """The group of each pixel, from 0, whose columns (n, k) are equal, shape (n,)."""
    rows = np.concatenate(columns, 1).astype(np.int64)
    return np.unique(rows, axis=0, return_inverse=True)[1].ravel()


def means_of(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The mean of values over the group of each pixel, shape (n,), as the arguments."""
    _, which = np.unique(groups, return_inverse=True)
    return (np.bincount(which, values) / np.bincount(which))[which]


def psnr(values: np.ndarray, truth: np.ndarray) -> float:
    """In dB, of values between 0 and 1."""
    return float(-10 * np.log10(np.square(values - truth).mean()))


def made_up(rows: np.ndarray, roughness: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Photographs of pixels with these materials, as light that is compared, shape (n, 3).

    Args:
        rows: of `row_type`.
        roughness: shape (n,).
        albedo: linear RGB, shape (n, 3).
    """
    from unbake.training.roughness_curves import at_roughness

    light = at_roughness(rows, roughness, ("plain", "coloured"))
    return rows["gain"] * (light["plain"] + towards(rows, albedo) * light["coloured"])


def towards(rows: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Factors of the fitted albedo that lead to another one, linear RGB, shape (n, 3)."""
    return np.clip(albedo / np.maximum(rows["albedo"], 1e-3), 0, LARGEST_FACTOR)


def recoloured(rows: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """The rows as they would be with another albedo, linear RGB, shape (n, 3)."""
    found, factor = rows.copy(), towards(rows, albedo)
    for name, power in (("coloured", 1), ("mixed", 1), ("coloured2", 2)):
        found[name] *= factor[:, None] ** power
    found["albedo"] *= factor
    return found


def without_noise(rows: np.ndarray) -> np.ndarray:
    """The rows as if their means over samples were exact: products are those of the means."""
    found = rows.copy()
    found["plain2"], found["coloured2"] = rows["plain"] ** 2, rows["coloured"] ** 2
    found["mixed"] = rows["plain"] * rows["coloured"]
    return found


if __name__ == "__main__":
    main()
