"""Sparse regression (PySINDy): a polynomial and a custom library of the recorded inputs and their derivatives."""

from __future__ import annotations

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
    "ddx": ["lag", "moving-average", "delay"],
    "t dx": ["clock-skew"],
    "x|x|": ["core-saturation"],
    "x^3": ["core-saturation"],
    "sign(dx)": ["core-hysteresis"],
}
BATTERY_TERMS = {
    "T": ["entropic"],
    "x T": ["resistance-temperature"],
    "x soc": ["resistance-soc"],
    "x soc^2": ["resistance-soc"],
    "sign(x)": ["ocv-hysteresis"],
    "dx": ["polarisation"],
    "ddx": ["polarisation"],
}
SHORT = {"temperature_c": "T", "supply_v": "V", "aux": "aux", "range_high": "high", "soc": "soc"}


@dataclass
class Terms:
    """A library for one degree, made on the fitted recording."""

    degree: int
    names: list[str]
    scale: dict[str, tuple[float, float]]


def fit(recording: Series) -> Fitted:
    """STLSQ on the residual; degree and threshold by cross-validation over contiguous blocks of the recording."""
    valid = recording.valid
    target = recording.residual[valid]
    size = float(target.std()) or 1.0
    best: tuple[float, int, float] | None = None
    for degree in DEGREES:
        _, terms = library(recording, degree)
        terms = terms[valid]
        for threshold in THRESHOLDS:
            loss = cross_validated(terms, target / size, threshold)
            if best is None or loss < best[0]:
                best = (loss, degree, threshold)
    _, degree, threshold = best
    names, terms = library(recording, degree)
    centre, spread = standard(terms[valid])
    coefficients = sparse((terms[valid] - centre) / spread, target / size, threshold) * size
    meaning = BATTERY_TERMS if recording.kind == "battery" else SENSOR_TERMS
    active = [name for name, c in zip(names, coefficients) if c != 0.0]
    known = [meaning[name] for name in active if name in meaning]
    classes = [list(group) for group in {tuple(group) for group in known} if len(group) > 1]

    def predict(series: Series) -> Array:
        return ((library(series, degree)[1] - centre) / spread) @ coefficients

    parameters = {name: float(c / s) for name, c, s in zip(names, coefficients, spread) if c != 0.0}
    note = f"degree {degree}, threshold {threshold}, {len(active)} of {len(names)} terms"
    return Fitted(sorted({group[0] for group in known}), predict, parameters, note, classes)


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


def cross_validated(terms: Array, target: Array, threshold: float) -> float:
    """Sum of squares over contiguous blocks that were left out in turn."""
    total = 0.0
    for block in np.array_split(np.arange(len(target)), BLOCKS):
        rest = np.setdiff1d(np.arange(len(target)), block, assume_unique=True)
        centre, spread = standard(terms[rest])
        coefficients = sparse((terms[rest] - centre) / spread, target[rest], threshold)
        total += float(np.sum((target[block] - ((terms[block] - centre) / spread) @ coefficients) ** 2))
    return total
