"""Sparse regression (PySINDy): a polynomial and a custom library of the recorded inputs and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pysindy

import filters
from result import Fitted
from series import Series

Array = np.ndarray

DEGREES = (1, 2, 3)
# Thresholds on the coefficients of standardised terms, in standard deviations of the residual.
THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)
RIDGE = 1e-3
BLOCKS = 5

# Terms that are an effect's own signature. A derivative stands by first order for three effects alike.
SENSOR_TERMS = {
    "1": ["offset"],
    "x": ["gain"],
    "T": ["offset-temperature"],
    "x T": ["gain-temperature"],
    "V": ["supply-ratiometric"],
    "x V": ["supply-ratiometric"],
    "aux": ["stray-field"],
    "high": ["range-mismatch"],
    "x high": ["range-mismatch"],
    "dx": ["lag", "moving-average", "delay"],
    "dx back": ["lag", "moving-average", "delay"],
    "ddx": ["lag", "moving-average", "delay"],
    "t dx": ["clock-skew"],
    "x|x|": ["core-saturation"],
    "x^3": ["core-saturation"],
    "sign(dx)": ["core-hysteresis"],
}
BATTERY_TERMS = {
    "x": ["resistance"],
    "T": ["entropic"],
    "x T": ["resistance-temperature"],
    "x soc": ["resistance-soc"],
    "x soc^2": ["resistance-soc"],
    "sign(x)": ["ocv-hysteresis"],
    "dx": ["polarisation"],
    "dx back": ["polarisation"],
    "ddx": ["polarisation"],
}
SHORT = {"temperature_c": "T", "supply_v": "V", "aux": "aux", "range_high": "high", "soc": "soc"}


@dataclass
class Choice:
    """What cross-validation decides: degree of the polynomial, threshold, and whether the residual has a state."""

    degree: int
    threshold: float
    dynamic: bool


def fit(recording: Series) -> Fitted:
    """STLSQ on the residual, as a function of the inputs or as a state of its own (SINDy with control, discrete time).

    Degree, threshold and which of the two: by cross-validation over contiguous blocks of the recording. The dynamic
    form is linear in its state: r[k] = a·r[k−1] + terms of the inputs; it is scored as a simulation from 0.
    """
    losses = []
    # Polled readings that count once have no reading in the row before: no state can be fitted to them.
    dynamics = (False, True) if follows(recording).sum() > 0.5 * recording.valid.sum() else (False,)
    for degree in DEGREES:
        terms = library(recording, degree)[1]
        for threshold in THRESHOLDS:
            for dynamic in dynamics:
                choice = Choice(degree, threshold, dynamic)
                losses.append((cross_validated(recording, terms, choice), len(losses), choice))
    choice = min(losses)[2]
    names, terms = library(recording, choice.degree)
    predict_terms, coefficients = train(recording, terms, choice, recording.valid)
    active = [name for name, c in zip(names, coefficients[: len(names)]) if c != 0.0]
    meaning = BATTERY_TERMS if recording.kind == "battery" else SENSOR_TERMS
    known = [meaning[name] for name in active if name in meaning]
    if choice.dynamic and coefficients[-1] > 0.0:
        known.append(["polarisation"] if recording.kind == "battery" else ["lag"])
    classes = [list(group) for group in {tuple(group) for group in known} if len(group) > 1]
    parameters = {name: float(c) for name, c in zip(names, coefficients) if c != 0.0}
    if choice.dynamic:
        parameters["r[k-1]"] = float(coefficients[-1])
    form = "with a state" if choice.dynamic else "static"
    note = f"{form}, degree {choice.degree}, threshold {choice.threshold}, {len(active)} of {len(names)} terms"

    def predict(series: Series) -> Array:
        return predict_terms(series, library(series, choice.degree)[1])

    return Fitted(sorted({group[0] for group in known}), predict, parameters, note, classes)


def train(recording: Series, terms: Array, choice: Choice, rows: Array) -> tuple[Callable[[Series, Array], Array], Array]:
    """Fits on the rows marked; gives a predictor and the coefficients of standardised terms (and of the state, last)."""
    target = recording.residual
    if choice.dynamic:
        rows = rows & follows(recording)
        columns = np.column_stack([terms, np.concatenate([[0.0], target[:-1]])])
    else:
        columns = terms
    size = float(target[rows].std()) or 1.0
    centre, spread = standard(columns[rows])
    if choice.dynamic:
        centre[-1], spread[-1] = 0.0, size
    coefficients = size * sparse((columns[rows] - centre) / spread, target[rows] / size, choice.threshold)

    def predict(series: Series, values: Array) -> Array:
        wide = values.shape[1]
        push = ((values - centre[:wide]) / spread[:wide]) @ coefficients[:wide]
        if not choice.dynamic:
            return push
        # A state that grows by itself is no model: it is held at the edge of stability.
        keep = float(np.clip(coefficients[-1] / size, -1.0, 1.0))
        starts = np.zeros(len(push), bool)
        starts[[part.start for part in series.segments]] = True
        push[starts] = 0.0
        return filters.recursion(np.where(starts, 0.0, keep)[1:], push[1:], 0.0)

    return predict, coefficients


def follows(recording: Series) -> Array:
    """Rows that were read, like the row before them in the same segment."""
    out = recording.valid.copy()
    out[1:] &= recording.valid[:-1]
    out[[part.start for part in recording.segments]] = False
    return out


def inputs(series: Series) -> dict[str, Array]:
    """Recorded inputs by short names; temperature and supply as deviations from their nominal values."""
    out = {"x": series.x}
    for name, short in SHORT.items():
        if name in series.other and np.ptp(series.other[name]) > 0:
            out[short] = series.other[name] - {"T": 25.0, "V": 5.0}.get(short, 0.0)
    return out


def library(series: Series, degree: int) -> tuple[list[str], Array]:
    """Names and values (rows × terms): polynomials of the inputs, and functions of the current and its derivatives."""
    recorded = inputs(series)
    polynomial = pysindy.PolynomialLibrary(degree=degree, include_bias=True)
    values = np.asarray(polynomial.fit_transform(np.column_stack(list(recorded.values()))))
    names = [polished(name) for name in polynomial.get_feature_names(list(recorded))]
    slope = filters.by_segment(filters.derivative, series.segments, series.t_s, series.x)
    bend = filters.by_segment(filters.derivative, series.segments, series.t_s, slope)
    own = {
        "dx": slope,
        "dx back": filters.by_segment(backward, series.segments, series.t_s, series.x),
        "ddx": bend,
        "t dx": series.t_s * slope,
        "x|x|": series.x * np.abs(series.x),
        "|x|": np.abs(series.x),
        "sign(x)": np.sign(series.x),
        "sign(dx)": np.sign(slope),
    }
    custom = pysindy.CustomLibrary([lambda value: value], function_names=[lambda name: name])
    extra = np.asarray(custom.fit_transform(np.column_stack(list(own.values()))))
    return [*names, *own], np.column_stack([values, extra])


def backward(t_s: Array, x: Array) -> Array:
    """Difference to the row before, per s: what a causal instrument knows."""
    return np.diff(x, prepend=x[0]) / np.maximum(np.diff(t_s, prepend=t_s[0] - 1.0), 1e-9)


def polished(name: str) -> str:
    """PySINDy's name of a term, factors in one order."""
    return " ".join(sorted(name.split(), key=lambda part: (not part.startswith("x"), part)))


def standard(terms: Array) -> tuple[Array, Array]:
    """Centre and spread of each term; the constant stays."""
    centre, spread = terms.mean(axis=0), terms.std(axis=0)
    constant = spread < 1e-12 * np.maximum(np.abs(centre), 1e-300)
    return np.where(constant, 0.0, centre), np.where(constant, 1.0, spread)


def sparse(terms: Array, target: Array, threshold: float) -> Array:
    """PySINDy's sequentially thresholded least squares on standardised terms."""
    optimiser = pysindy.STLSQ(threshold=threshold, alpha=RIDGE, max_iter=20)
    optimiser.fit(terms, target[:, None])
    return np.asarray(optimiser.coef_).ravel()


def cross_validated(recording: Series, terms: Array, choice: Choice) -> float:
    """Sum of squares over contiguous blocks that were left out in turn."""
    total = 0.0
    rows = np.flatnonzero(recording.valid)
    for block in np.array_split(rows, BLOCKS):
        rest = recording.valid.copy()
        rest[block] = False
        predict, _ = train(recording, terms, choice, rest)
        total += float(np.sum((recording.residual[block] - predict(recording, terms)[block]) ** 2))
    return total if np.isfinite(total) else np.inf
