"""The training set: windows drawn from the labelled paths of a dataset, afresh for each epoch.

A window begins at the path's start, ends at its end, or lies anywhere between, with nodes spaced as in
flights or as in the labels. The start state that the network receives is slightly wrong, as in a chain of windows.
"""

from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import perturbed
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset import read_dataset
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.features import (
    COLUMNS,
    INPUTS,
    OUTPUTS,
    REFERENCE,
    ScaledLimits,
    coefficient_logs,
    fill_inputs,
    fill_node_features,
    scaled_limits,
    start_features,
)
from cfplan.machine_code import njit
from cfplan.planners.solution import Status
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import airframe_of
from cfplan.vehicle.profile import h_within, yaw_within

MIN_SPEED_FACTOR = 0.97  # at which a label must be certified to be used
# m: the few longer paths are excursions of min-snap to hundreds of metres, and long flights are chains of windows
MAX_LENGTH = 100.0
CLOSEST = 0.12  # m of path between the nodes of the closest windows
WIDEST = 2.0  # spacing of the widest windows, over the label's: as when a short path is one window
AT_START, AT_END = 0.25, 0.25  # fractions of the windows that begin, or end, where the path does
UNKNOWN = 0.8  # fraction of the windows inside a path whose start state is withheld
START_NOISE = (0.01, 0.01, 0.005)  # standard deviations of the noise on the start state: rate, slope, bend
TAIL = 16  # nodes next to a window's end inside a path, whose speed depends on what lies beyond
TAIL_WEIGHT = 0.1  # of the last of them in the loss
UNSEEN_FRACTION, MAX_UNSEEN = 0.1, 500  # of the paths, held out for validation
SPLIT_STREAM = 0  # number of this stream of a seed's random numbers


class Labels(NamedTuple):
    """R labelled paths in flat arrays, as compiled loops take them; each path in the units of its own limits."""

    pieces: NDArray  # (R+1,) where each path's coefficients begin
    breaks: NDArray  # (sum of pieces + R,) path by path
    coefficients: NDArray  # (sum of pieces, D, 3)
    length: NDArray  # (R,) m
    h: NDArray  # (R, 4, N+1) h, h', h'', h'''
    yaw: NDArray  # (R, 3, N+1) ψ, ψ', ψ''
    chooses: NDArray  # (R,) whether yaw is the network's to choose
    bounds: NDArray  # (R, BOUNDS), see features.ScaledLimits
    numbers: NDArray  # (R, NUMBERS)


class Batch(NamedTuple):
    """B windows."""

    inputs: NDArray  # (B, W+1, INPUTS) float32
    targets: NDArray  # (B, W+1, OUTPUTS) float32
    weights: NDArray  # (B, W+1) float32, of the squared errors
    times: NDArray  # float32, fraction of the window's time that is spent about each node


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """The usable rows of a dataset."""

    spec: DatasetSpec
    rows: NDArray  # (R,) numbers of the rows
    paths: tuple[Path, ...]
    scaled: tuple[ScaledLimits, ...]
    labels: Labels
    travel_time: NDArray  # (R,) s

    def part(self, chosen: NDArray) -> "TrainingSet":
        """Return some of the rows, by index."""
        paths, known = tuple(self.paths[i] for i in chosen), tuple(self.scaled[i] for i in chosen)
        labels = Labels(*_joined(paths, known), *(values[chosen] for values in self.labels[3:]))
        travel_time = self.travel_time[chosen]
        return replace(self, rows=self.rows[chosen], paths=paths, scaled=known, labels=labels, travel_time=travel_time)

    def noisy(self, epsilon: float, seed: np.random.SeedSequence) -> Labels:
        """Return the labels with every path perturbed by at most epsilon, m: noise injection, with unchanged labels."""
        seeds = seed.spawn(len(self.paths))
        paths = tuple(perturbed(path, epsilon, own) for path, own in zip(self.paths, seeds, strict=True))
        return Labels(*_joined(paths, self.scaled), *self.labels[3:])


def read_training_set(folder: FilePath, *, max_length: float = MAX_LENGTH) -> TrainingSet:
    """Read the usable rows of a dataset.

    Raises:
        InputError: no dataset, a damaged one, or no two paths that were solved and certified.
    """
    spec, rows = read_dataset(folder)
    usable = rows.filter(
        (pa.compute.field("status") == Status.SOLVED.name)
        & (pa.compute.field("certified_share") >= MIN_SPEED_FACTOR)
        & (pa.compute.field("length") <= max_length)
    )
    if usable.num_rows < 2:
        raise InputError(
            f"{usable.num_rows} of {rows.num_rows} rows are usable (solved, certified at {MIN_SPEED_FACTOR:.0%} of "
            f"their speed, and no longer than {max_length:g} m); at least two are needed",
            where=str(folder),
            hint="see `cfplan dataset info`, and make another",
        )
    length, travel_time = (_positive(usable, name, folder) for name in ("length", "travel_time"))
    paths = _paths(usable, folder)
    h = np.stack([_column(usable, name, spec.nodes, folder) for name in ("h", "dh", "ddh", "dddh")], axis=1)
    yaw = np.stack([_column(usable, name, spec.nodes, folder) for name in ("yaw", "dyaw", "ddyaw")], axis=1)
    known, chooses = _scaled(usable, folder), usable["yaw_mode"].to_numpy() == YawMode.FREE.value
    h *= np.array([each.time**2 for each in known])[:, None, None]
    bounds, numbers = np.stack([each.bounds for each in known]), np.stack([each.numbers for each in known])
    labels = Labels(*_joined(paths, known), length, h, yaw, chooses, bounds, numbers)
    row_numbers = usable["row"].to_numpy()
    if len(np.unique(row_numbers // (1 + spec.copies))) < 2:
        raise InputError(
            "only one path, and validation needs another", where=str(folder), hint="make a dataset of more paths"
        )
    return TrainingSet(spec, row_numbers, paths, known, labels, travel_time)


def _scaled(rows: pa.Table, folder: FilePath) -> tuple[ScaledLimits, ...]:
    found = []
    columns = (rows[name].to_pylist() for name in ("row", "airframe", "limits"))
    for row, airframe, limits in zip(*columns, strict=True):
        try:
            known = scaled_limits(airframe_of(airframe), PlanLimits(**limits))
        except (KeyError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
            raise _damaged(f"limits or vehicle of row {row}: {error}", folder) from None
        if not (np.isfinite(known.numbers).all() and np.isfinite(known.bounds).all() and (known.bounds > 0.0).all()):
            raise _damaged(f"limits or vehicle of row {row} are not those of a flight", folder)
        found.append(known)
    return tuple(found)


def _column(rows: pa.Table, name: str, nodes: int, folder: FilePath) -> NDArray:
    """Return (R, N+1); a column of N values a row is padded at the end."""
    expected = nodes + (name not in ("dddh", "ddyaw"))
    column = rows[name].combine_chunks()
    if (
        column.null_count
        or not pa.compute.all(pa.compute.equal(pa.compute.list_value_length(column), expected)).as_py()
    ):
        raise _damaged(f"{name} has not {expected} values in every row", folder)
    values = column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), expected)
    if not np.isfinite(values).all() or (name == "h" and not (values >= 0.0).all()):
        raise _damaged(f"{name} holds what no label has", folder)
    return np.pad(values, ((0, 0), (0, nodes + 1 - expected)), mode="edge")


def _positive(rows: pa.Table, name: str, folder: FilePath) -> NDArray:
    """Return (R,)."""
    values = rows[name].to_numpy().astype(float)
    if not ((values > 0.0) & (values < np.inf)).all():
        raise _damaged(f"{name} is not positive in every row", folder)
    return values


def _paths(rows: pa.Table, folder: FilePath) -> tuple[Path, ...]:
    paths = []
    for row, breaks, coefficients in zip(
        *(rows[name].to_pylist() for name in ("row", "breaks", "coefficients")), strict=True
    ):
        try:
            paths.append(Path(np.array(breaks), np.array(coefficients).reshape(len(breaks) - 1, -1, 3)))
        except (InputError, ValueError, TypeError) as error:
            raise _damaged(f"the path of row {row}: {error}", folder) from None
    return tuple(paths)


def _damaged(why: str, folder: FilePath) -> InputError:
    return InputError(f"damaged: {why}", where=str(folder), hint="make the dataset again with `cfplan dataset make`")


def _joined(paths: tuple[Path, ...], known: tuple[ScaledLimits, ...]) -> tuple[NDArray, NDArray, NDArray]:
    pieces = np.cumsum([0] + [len(path.coefficients) for path in paths])
    powers = max(path.coefficients.shape[1] for path in paths)
    coefficients = np.zeros((pieces[-1], powers, 3))
    for path, first, units in zip(paths, pieces, known, strict=False):
        there = coefficients[first : first + len(path.coefficients), : path.coefficients.shape[1]]
        there[:] = path.coefficients / units.length
    return pieces, np.concatenate([path.breaks for path in paths]), coefficients


def split(training_set: TrainingSet, seed: int) -> tuple[TrainingSet, TrainingSet]:
    """Return the training set and, held out for validation, the unseen. A path's copies stay with it."""
    paths = training_set.rows // (1 + training_set.spec.copies)
    known = np.unique(paths)
    order = np.random.default_rng([seed, SPLIT_STREAM]).permutation(known)
    count = min(MAX_UNSEEN, max(1, round(UNSEEN_FRACTION * len(known))))
    apart = np.isin(paths, order[:count])
    return training_set.part(np.flatnonzero(~apart)), training_set.part(np.flatnonzero(apart))


def draw(
    labels: Labels,
    rows: NDArray,
    window: int,
    random: np.random.Generator,
    *,
    at_start: float = AT_START,
    at_end: float = AT_END,
    closest: float = CLOSEST,
    widest: float = WIDEST,
) -> Batch:
    """Draw one window from each of these rows, (B,)."""
    count, nodes = len(rows), labels.h.shape[2] - 1
    most = widest * labels.length[rows] / nodes  # m between nodes
    spacing = np.exp(random.uniform(np.log(np.minimum(closest, 0.8 * most)), np.log(most)))
    share = np.minimum(spacing / labels.length[rows], 1.0 / window)  # of the path, an interval
    where = random.uniform(size=count)
    room = 1.0 - window * share
    first = room * np.clip((where - at_start) / (1.0 - at_start - at_end), 0.0, 1.0)
    knows = random.uniform(size=count) >= UNKNOWN
    noise = random.normal(size=(count, 3)) * START_NOISE
    batch = Batch(
        np.empty((count, window + 1, INPUTS), np.float32), np.empty((count, window + 1, OUTPUTS), np.float32),
        np.empty((count, window + 1), np.float32), np.empty((count, window + 1), np.float32),
    )  # fmt: skip
    _fill(*batch, labels, rows, first, share, knows, noise)
    return batch


@njit(error_model="numpy")
def _fill(
    inputs: NDArray, targets: NDArray, weights: NDArray, times: NDArray, labels: Labels, rows: NDArray,
    first: NDArray, share: NDArray, knows: NDArray, noise: NDArray,
) -> None:  # fmt: skip
    count = inputs.shape[1]
    grid = labels.h.shape[2] - 1
    table, turns, yaws = np.empty((count, COLUMNS)), np.empty((count, 2)), np.empty(count)
    for b in range(len(rows)):
        row = rows[b]
        low, high = labels.pieces[row], labels.pieces[row + 1]
        breaks = labels.breaks[low + row : high + row + 1]
        end = breaks[-1]
        step = share[b] * end
        chooses = labels.chooses[row]
        for n in range(count):
            place = min((first[b] + n * share[b]) * grid, grid * 1.0)
            i = min(int(place), grid - 1)
            psi, dpsi, ddpsi = yaw_within(
                (place - i) * end / grid, labels.yaw[row, 0, i], labels.yaw[row, 1, i], labels.yaw[row, 2, i]
            )
            yaws[n] = psi
            turns[n, 0], turns[n, 1] = dpsi * step, ddpsi * step * step
        yaw, turning = yaws[0], turns[0, 0]
        if chooses:
            turns[:] = 0.0
        fill_node_features(
            table, breaks, labels.coefficients[low:high], first[b] * end, step, labels.bounds[row], turns
        )
        rest_start, rest_end = first[b] <= 0.0, first[b] + (count - 1) * share[b] >= 1.0 - 1e-9
        total = 0.0
        start = (0.0, 0.0, 0.0)
        known = knows[b] and not rest_start
        for n in range(count):
            place = min((first[b] + n * share[b]) * grid, grid * 1.0)
            i = min(int(place), grid - 1)
            x = (place - i) * end / grid
            h0, h1, h2, h3 = labels.h[row, 0, i], labels.h[row, 1, i], labels.h[row, 2, i], labels.h[row, 3, i]
            h, dh, ddh, _ = h_within(x, h0, h1, h2, h3)
            slope, bend = dh * step, ddh * step * step
            if n == 0:
                start = start_features(*coefficient_logs(h, slope, bend, step))
                start = (start[0] + noise[b, 0], start[1] + noise[b, 1], start[2] + noise[b, 2])
            rate = coefficient_logs(h, slope, bend, step)[1]
            targets[b, n, 0] = rate - table[n, REFERENCE]
            targets[b, n, 1] = np.cos(yaws[n] - yaw) if chooses else 1.0
            targets[b, n, 2] = np.sin(yaws[n] - yaw) if chooses else 0.0
            duration = np.exp(-rate) * (0.5 if n in (0, count - 1) else 1.0)
            times[b, n] = duration
            total += duration
            fading = 0 if rest_end else max(0, n + 1 + TAIL - count)
            if not (known or rest_start):
                fading = max(fading, TAIL - n)
            weights[b, n] = 1.0 - (1.0 - TAIL_WEIGHT) * fading / TAIL
        fill_inputs(inputs[b], table, rest_start, rest_end, known, start, yaw, turning, chooses, labels.numbers[row])
        for n in range(count):
            times[b, n] /= total
