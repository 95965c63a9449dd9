"""A Gaussian process on the residual: no physics, any smooth function of what was recorded."""

from __future__ import annotations

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, Kernel, WhiteKernel

import filters
from result import Fitted
from series import Series

Array = np.ndarray

# Rows that the process rests on, and those by which its length scales are found: the work grows with the third power.
POINTS = 800
POINTS_FOR_SCALES = 300
# Lags of the current, in steps between rows.
LAGS = (1, 2, 5)
# Time constants of the battery's past current, in s.
MEMORY_S = (10.0, 100.0)


def fit(recording: Series) -> Fitted:
    """Two kernels, with and without a straight line: length scales by maximum likelihood, the better one on rows not used."""
    inputs = features(recording, recording.step_s)
    rows = np.flatnonzero(recording.valid)
    centre, scale = inputs[rows].mean(axis=0), inputs[rows].std(axis=0)
    used = scale > 1e-9 * np.abs(inputs[rows]).max()
    target = recording.residual
    level, size = float(target[rows].mean()), float(target[rows].std()) or 1.0

    def standardised(values: Array) -> Array:
        return ((values - centre) / np.where(used, scale, 1.0))[:, used]

    def train(kernel: Kernel, count: int, optimiser: str | None) -> GaussianProcessRegressor:
        chosen = thinned(rows, count)
        process = GaussianProcessRegressor(kernel, optimizer=optimiser, random_state=0)
        return process.fit(standardised(inputs[chosen]), (target[chosen] - level) / size)

    smooth = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(np.full(used.sum(), 2.0), (0.05, 1e3))
    straight = ConstantKernel(0.1, (1e-6, 1e3)) * DotProduct(1.0, (1e-2, 1e2))
    noise = WhiteKernel(0.3, (1e-3, 2.0))
    starts = (smooth + noise, smooth + straight + noise)
    tried = [train(train(kernel, POINTS_FOR_SCALES, "fmin_l_bfgs_b").kernel_, POINTS, None) for kernel in starts]
    others = np.setdiff1d(rows, thinned(rows, POINTS))
    others = thinned(others if len(others) else rows, POINTS)

    def loss(process: GaussianProcessRegressor) -> float:
        return float(np.sum((level + size * process.predict(standardised(inputs[others])) - target[others]) ** 2))

    process = min(tried, key=loss)

    def predict(series: Series) -> Array:
        values = standardised(features(series, recording.step_s))
        parts = [process.predict(values[k : k + 4000]) for k in range(0, len(values), 4000)]
        return level + size * np.concatenate(parts)

    note = f"{min(POINTS, len(rows))} of {len(rows)} rows; kernel {process.kernel_}"
    return Fitted([], predict, None, note)


def features(series: Series, step_s: float) -> Array:
    """Inputs recorded, the current some steps ago and, for a battery, its past current."""
    columns = [series.x]
    for lag in LAGS:
        columns.append(filters.by_segment(filters.shifted, series.segments, series.t_s, series.x, lag * step_s))
    columns += [values for name, values in series.other.items() if name != "slope_v"]
    if series.kind == "battery":
        columns += [filters.by_segment(filters.low_pass, series.segments, series.t_s, series.x, tau, 0.0) for tau in MEMORY_S]
    return np.column_stack(columns)


def thinned(rows: Array, count: int) -> Array:
    """Rows at random, the same each time."""
    if len(rows) <= count:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, count, replace=False))
