"""Straight line, forward selection by BIC (independent or AR(1) errors), and all effects at once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq, qr
from scipy.optimize import minimize_scalar
from scipy.stats import f as f_distribution

from dictionary import MOST_OF_ONE, Entry, dictionary, nuisances
from result import Fitted
from series import Series

Array = np.ndarray

# Two-sided 1 % of the normal distribution.
Z_1_PERCENT = 2.5758
# No more effects than the library has rows for one view.
MOST_ENTRIES = 20
# A difference of BIC below this is "not worth more than a bare mention" (Kass and Raftery 1995).
NO_EVIDENCE = 2.0


def straight_line(recording: Series) -> Fitted:
    """Ordinary least squares of the reading on the simulation: zero and slope, each named if its t-test at 1 % says so."""
    valid = recording.valid
    columns = np.column_stack([np.ones(valid.sum()), recording.simulated[valid]])
    target = recording.residual[valid]
    coefficients, *_ = np.linalg.lstsq(columns, target, rcond=None)
    left = target - columns @ coefficients
    covariance = np.linalg.pinv(columns.T @ columns) * (left @ left) / max(len(target) - 2, 1)
    t_values = np.abs(coefficients) / np.sqrt(np.diag(covariance))
    zero, slope = (float(c) for c in coefficients)
    named = [name for name, t in zip(("offset", "gain"), t_values) if t > Z_1_PERCENT]
    parameters = {"offset": {"offset_a": zero}, "gain": {"gain": 1.0 + slope}}
    note = "t-test at 1 %, independent errors"
    if recording.kind == "battery":
        named, parameters = [], {"zero_v": zero, "slope": 1.0 + slope}
        note = "line through the voltage; no effect of the library is one, so none is named"
    return Fitted(named, lambda series: zero + slope * series.simulated, parameters, note)


@dataclass
class Model:
    """Entries taken, and what is needed to weigh another one."""

    entries: list[Entry]
    # Columns of the nuisances, then of each entry, before any transform.
    blocks: list[Array]
    phi: float
    score: float
    # What it leaves and the basis of its columns, once asked for.
    rest: tuple[Array, Array] | None = None

    @property
    def columns(self) -> Array:
        """All columns side by side."""
        return np.column_stack(self.blocks)


class Stepwise:
    """Forward selection with backward steps over the dictionary, by BIC."""

    def __init__(self, recording: Series, ar1: bool) -> None:
        self.recording = recording
        self.ar1 = ar1
        valid = recording.valid
        self.target = recording.residual[valid]
        self.first = first_rows(recording)
        self.base = nuisances(recording)[valid]
        self.entries = dictionary(recording)
        self.pool = [unit(self.columns(entry)) for entry in self.entries]

    def columns(self, entry: Entry) -> Array:
        """Columns of an entry on the rows that were read."""
        return entry.columns(self.recording)[self.recording.valid]

    def run(self) -> Model:
        """Adds the best entry, its value tuned, and drops what is no longer needed, while BIC falls."""
        model = self.fit([], [self.base])
        for _ in range(2 * MOST_ENTRIES):
            grown = self.grow(model)
            if grown is None or grown.score >= model.score or len(grown.entries) > MOST_ENTRIES:
                break
            model = self.prune(grown)
        return model

    def grow(self, model: Model) -> Model | None:
        """The model with the entry that lowers the sum of squares most for its number of parameters."""
        best, chosen = 0.0, None
        left, basis = self.left(model)
        rows = len(left)
        energy = float(left @ left)
        taken = Counter(entry.id for entry in model.entries)
        for entry, columns in zip(self.entries, self.pool):
            if taken[entry.id] >= MOST_OF_ONE.get(entry.id, 1):
                continue
            gain = gain_of(self.whiten(columns, model.phi), basis, left, entry.positive)
            fall = -rows * np.log(max(1.0 - gain / energy, 1e-12)) - cost(entry) * np.log(rows)
            if fall > best:
                best, chosen = fall, entry
        if chosen is None:
            return None
        chosen = self.tune(chosen, model)
        return self.fit([*model.entries, chosen], [*model.blocks, self.columns(chosen)], model.phi)

    def tune(self, entry: Entry, model: Model) -> Entry:
        """Moves the entry's value within its neighbours on the grid to the least sum of squares."""
        if not entry.tuned:
            return entry
        left, basis = self.left(model)

        def loss(value: float) -> float:
            columns = self.whiten(unit(self.columns(entry.moved(value))), model.phi)
            return -gain_of(columns, basis, left, entry.positive)

        span = (entry.low, entry.high)
        found = minimize_scalar(loss, bounds=span, method="bounded", options={"xatol": 1e-3 * (span[1] - span[0])})
        return entry.moved(float(found.x)) if found.fun < loss(entry.value) else entry

    def prune(self, model: Model) -> Model:
        """Drops the entry without which BIC is lowest, while that helps."""
        while len(model.entries) > 1:
            place = self.idlest(model)
            entries = model.entries[:place] + model.entries[place + 1 :]
            shorter = self.fit(entries, model.blocks[: place + 1] + model.blocks[place + 2 :], model.phi)
            if shorter.score >= model.score:
                break
            model = shorter
        return model

    def idlest(self, model: Model) -> int:
        """The entry whose loss raises BIC least, at the model's correlation of errors."""
        columns = self.whiten(unit(model.columns), model.phi)
        inverse = np.linalg.pinv(columns.T @ columns)
        coefficients = inverse @ (columns.T @ self.whiten(self.target, model.phi))
        rises, place = [], self.base.shape[1]
        for entry, block in zip(model.entries, model.blocks[1:]):
            own = slice(place, place + block.shape[1])
            place = own.stop
            loss = coefficients[own] @ np.linalg.pinv(inverse[own, own]) @ coefficients[own]
            rises.append(loss / self.variance(model) - cost(entry) * np.log(len(self.target)))
        return int(np.argmin(rises))

    def variance(self, model: Model) -> float:
        """Mean square of what the model leaves, whitened."""
        left, _ = self.left(model)
        return float(left @ left) / len(left)

    def equivalents(self, model: Model) -> list[list[str]]:
        """For each entry taken, the effects that would do in its stead: BIC within 2, the usual "no evidence"."""
        out = []
        for place, entry in enumerate(model.entries):
            rest = self.fit(model.entries[:place] + model.entries[place + 1 :], model.blocks[: place + 1] + model.blocks[place + 2 :], model.phi)
            rest = Model(rest.entries, rest.blocks, model.phi, rest.score)
            own = self.worth(entry, rest)
            others = {e.id for e in rest.entries}
            found = {entry.id}
            for name, other in self.best_of_each(rest).items():
                if name not in found and name not in others and self.worth(self.tune(other, rest), rest) > own - NO_EVIDENCE:
                    found.add(name)
            if len(found) > 1:
                out.append(sorted(found))
        return out

    def worth(self, entry: Entry, model: Model) -> float:
        """By how much BIC falls with the entry, at the model's correlation of errors."""
        left, basis = self.left(model)
        columns = self.whiten(unit(self.columns(entry)), model.phi)
        share = gain_of(columns, basis, left, entry.positive) / max(float(left @ left), 1e-300)
        return -len(left) * np.log(max(1.0 - share, 1e-12)) - cost(entry) * np.log(len(left))

    def best_of_each(self, model: Model) -> dict[str, Entry]:
        """The entry of each effect that lowers the sum of squares most."""
        left, basis = self.left(model)
        best: dict[str, tuple[float, Entry]] = {}
        for entry, columns in zip(self.entries, self.pool):
            gain = gain_of(self.whiten(columns, model.phi), basis, left, entry.positive)
            if gain > best.get(entry.id, (0.0, entry))[0]:
                best[entry.id] = (gain, entry)
        return {name: entry for name, (_, entry) in best.items()}

    def fit(self, entries: list[Entry], blocks: list[Array], phi: float = 0.0) -> Model:
        """Least squares (AR(1): Cochrane–Orcutt, Prais–Winsten's first row) and BIC."""
        columns = np.column_stack(blocks)
        for _ in range(8 if self.ar1 else 0):
            left = self.target - columns @ self.solve(columns, phi)
            before, phi = phi, self.correlation(left)
            if abs(phi - before) < 1e-4:
                break
        left = self.whiten(self.target - columns @ self.solve(columns, phi), phi)
        rows, starts = len(left), int(self.first.sum())
        parameters = self.base.shape[1] + sum(cost(entry) for entry in entries) + self.ar1
        likelihood = rows * np.log(max(left @ left, 1e-300) / rows) - starts * np.log(1.0 - phi * phi)
        return Model(entries, blocks, phi, float(likelihood + parameters * np.log(rows)))

    def solve(self, columns: Array, phi: float) -> Array:
        """Coefficients by least squares on standardised columns."""
        if columns.shape[1] == 0:
            return np.zeros(0)
        size = np.linalg.norm(columns, axis=0)
        size[size == 0] = 1.0
        whitened = self.whiten(columns / size, phi)
        return lstsq(whitened, self.whiten(self.target, phi), cond=1e-10, lapack_driver="gelsy", check_finite=False)[0] / size

    def correlation(self, left: Array) -> float:
        """Correlation of neighbouring errors within segments."""
        inner = ~self.first[1:]
        product = float(np.sum((left[1:] * left[:-1])[inner]))
        return float(np.clip(product / max(float(np.sum(left[:-1][inner] ** 2)), 1e-300), -0.999, 0.9999))

    def whiten(self, values: Array, phi: float) -> Array:
        """v[k] − φ·v[k−1]; the first row of a segment times √(1 − φ²)."""
        if phi == 0.0:
            return values
        out = values.copy()
        out[1:] -= phi * values[:-1]
        out[self.first] = np.sqrt(1.0 - phi * phi) * values[self.first]
        return out

    def left(self, model: Model) -> tuple[Array, Array]:
        """What the model leaves, and an orthonormal basis of its columns, both whitened."""
        if model.rest is None:
            target = self.whiten(self.target, model.phi)
            basis = orthonormal(self.whiten(model.columns, model.phi))
            model.rest = target - basis @ (basis.T @ target), basis
        return model.rest


def first_rows(recording: Series) -> Array:
    """Marks the first row read of each segment, over the rows read."""
    segment = np.zeros(len(recording.x), int)
    for number, part in enumerate(recording.segments):
        segment[part] = number
    read = segment[recording.valid]
    return np.concatenate([[True], np.diff(read) != 0])


def unit(columns: Array) -> Array:
    """Columns over their length."""
    size = np.linalg.norm(columns, axis=0)
    return columns / np.where(size > 0, size, 1.0)


def orthonormal(columns: Array, floor: float = 1e-7) -> Array:
    """An orthonormal basis of the columns; dependent ones fall away."""
    if columns.shape[1] == 0:
        return columns
    basis, triangle, _ = qr(unit(columns), mode="economic", pivoting=True, check_finite=False)
    return basis[:, np.abs(np.diag(triangle)) > floor]


def cost(entry: Entry) -> int:
    """Parameters of an entry: its coefficients and, if it has one, its value on the grid."""
    return len(entry.coefficients) + entry.tuned


def gain_of(columns: Array, basis: Array, left: Array, positive: bool) -> float:
    """By how much the columns lower the sum of squares beyond the basis; `positive`: 0 if only a negative one would."""
    rest = columns - basis @ (basis.T @ columns)
    # Nothing new within rounding: the column is one of the model's.
    if rest.shape[1] == 1:
        size, along = float(rest[:, 0] @ rest[:, 0]), float(rest[:, 0] @ left)
        known = size <= 1e-9 * float(columns[:, 0] @ columns[:, 0])
        return 0.0 if known or (positive and along < 0) else along**2 / size
    projected = orthonormal(rest).T @ left
    return float(projected @ projected)


def stepwise(recording: Series, ar1: bool) -> Fitted:
    """Names the effects of the entries that BIC keeps."""
    search = Stepwise(recording, ar1)
    model = search.run()
    coefficients = search.solve(model.columns, model.phi)
    note = f"{len(search.entries)} entries in the dictionary, {len(model.entries)} taken" + (f", phi {model.phi:.4f}" if ar1 else "")
    fitted = from_entries(search.base.shape[1], model.entries, coefficients, note)
    fitted.classes = search.equivalents(model)
    return fitted


def from_entries(base: int, entries: list[Entry], coefficients: Array, note: str) -> Fitted:
    """A linear model of nuisances and entries."""
    parameters: dict[str, list[dict[str, float]]] = {}
    place = base
    for entry in entries:
        width = len(entry.coefficients)
        parameters.setdefault(entry.id, []).append(entry.described(coefficients[place : place + width]))
        place += width

    def predict(series: Series) -> Array:
        columns = np.column_stack([nuisances(series), *(entry.columns(series) for entry in entries)])
        return columns @ coefficients

    return Fitted(sorted({entry.id for entry in entries}), predict, parameters, note)


def all_at_once(recording: Series) -> Fitted:
    """Least squares on the whole dictionary; an effect is named if an F-test says that its columns are needed.

    F-test of all columns of an effect together against the model without them, 1 % over the number of effects
    (Bonferroni), independent errors; with fewer rows than columns no test, and no name. Columns that the others make up
    are left out. If what is left is singular to eight digits, the prediction is by ridge regression, its weight by
    five-fold cross-validation over contiguous blocks.
    """
    valid = recording.valid
    entries = dictionary(recording)
    blocks = [nuisances(recording), *(entry.columns(recording) for entry in entries)]
    owner = np.repeat(["", *(entry.id for entry in entries)], [block.shape[1] for block in blocks])
    columns, target = np.column_stack(blocks)[valid], recording.residual[valid]
    size = np.linalg.norm(columns, axis=0)
    columns = columns / size
    _, triangle, order = qr(columns, mode="economic", pivoting=True, check_finite=False)
    diagonal = np.abs(np.diag(triangle))
    kept = np.sort(order[: len(diagonal)][diagonal > 1e-9 * diagonal[0]])
    singular = len(kept) < columns.shape[1] or np.linalg.cond(columns[:, kept]) > 1e8
    named = needed(columns[:, kept], target, owner[kept]) if len(kept) < len(target) else []
    weight = ridge_weight(columns, target) if singular else 0.0
    coefficients = ridge(columns, target, weight) / size

    def predict(series: Series) -> Array:
        return np.column_stack([nuisances(series), *(entry.columns(series) for entry in entries)]) @ coefficients

    note = f"{columns.shape[1]} columns; " + (f"ridge, weight {weight:.1e}" if singular else "ordinary least squares")
    return Fitted(named, predict, None, note)


def needed(columns: Array, target: Array, owner: Array) -> list[str]:
    """Effects whose columns together pass the F-test."""
    basis, triangle = qr(columns, mode="economic", check_finite=False)
    along = basis.T @ target
    freedom = len(target) - columns.shape[1]
    variance = max(float(target @ target - along @ along) / freedom, 1e-300)
    effects = sorted(set(owner.tolist()) - {""})
    named = []
    for effect in effects:
        own = owner == effect
        # What only this effect's columns reach of the target.
        others = orthonormal(triangle[:, ~own], 1e-10)
        rise = float(along @ along) - float(np.sum((others.T @ along) ** 2))
        if f_distribution.sf(rise / own.sum() / variance, own.sum(), freedom) < 0.01 / len(effects):
            named.append(effect)
    return named


def ridge(columns: Array, target: Array, weight: float) -> Array:
    """Least squares with a penalty on columns of length 1."""
    if weight == 0.0:
        return lstsq(columns, target, check_finite=False)[0]
    wide = columns.shape[1]
    return np.linalg.solve(columns.T @ columns + weight * np.eye(wide), columns.T @ target)


def ridge_weight(columns: Array, target: Array) -> float:
    """The weight with the least error over five contiguous blocks."""
    blocks = np.array_split(np.arange(len(target)), 5)

    def loss(weight: float) -> float:
        total = 0.0
        for block in blocks:
            rest = np.setdiff1d(np.arange(len(target)), block, assume_unique=True)
            total += float(np.sum((target[block] - columns[block] @ ridge(columns[rest], target[rest], weight)) ** 2))
        return total

    return min(10.0 ** np.arange(-9, 2), key=loss)
