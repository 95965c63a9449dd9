"""What sensors and cells do to a signal, on rows at any times: straight lines between rows, segment by segment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import solve_banded
from scipy.signal import lfilter

Array = np.ndarray


def by_segment(operator: Callable[..., Array], segments: list[slice], t_s: Array, x: Array, *rest: float) -> Array:
    """Applies an operator to each segment by itself."""
    out = np.empty(len(x))
    for part in segments:
        out[part] = operator(t_s[part], x[part], *rest)
    return out


def low_pass(t_s: Array, x: Array, tau_s: float, start: float | None = None) -> Array:
    """First-order low-pass, exact for straight lines between rows; `start`: its state at first (None: settled)."""
    state = float(x[0]) if start is None else start
    if len(x) < 2:
        return np.full(len(x), state)
    step = np.diff(t_s)
    keep, now, before = ramp(step, tau_s)
    if np.ptp(step) < 1e-3 * step[0]:
        push = now[0] * x[1:] + before[0] * x[:-1]
        return np.concatenate([[state], lfilter([1.0], [1.0, -keep[0]], push, zi=[keep[0] * state])[0]])
    return recursion(keep, now * x[1:] + before * x[:-1], state)


def ramp(step_s: Array, tau_s: float) -> tuple[Array, Array, Array]:
    """Weights of the last state, of the new and of the old input, for a straight line over each step."""
    ratio = np.maximum(step_s, 1e-9) / tau_s
    now = 1.0 + np.expm1(-ratio) / ratio
    return np.exp(-ratio), now, -np.expm1(-ratio) - now


def recursion(keep: Array, push: Array, state: float) -> Array:
    """y[k] = keep[k]·y[k−1] + push[k] from `state`, as one system of two diagonals."""
    bands = np.ones((2, len(push) + 1))
    bands[1, :-1] = -keep
    return solve_banded((1, 0), bands, np.concatenate([[state], push]), check_finite=False)


def boxcar(t_s: Array, x: Array, window_s: float) -> Array:
    """Mean over the last `window_s`, in s; the first value stood before the start."""
    if len(x) < 2:
        return x.copy()
    area = integral(t_s, x)
    return (at(t_s, t_s, area, x) - at(t_s - window_s, t_s, area, x)) / window_s


def shifted(t_s: Array, x: Array, delay_s: float) -> Array:
    """The signal `delay_s` ago, in s."""
    return np.interp(t_s - delay_s, t_s, x)


def derivative(t_s: Array, x: Array) -> Array:
    """Central difference, per s."""
    if len(x) < 3:
        return np.zeros(len(x))
    span = np.empty(len(x))
    rise = np.empty(len(x))
    span[1:-1], rise[1:-1] = t_s[2:] - t_s[:-2], x[2:] - x[:-2]
    span[0], rise[0] = t_s[1] - t_s[0], x[1] - x[0]
    span[-1], rise[-1] = t_s[-1] - t_s[-2], x[-1] - x[-2]
    return rise / np.maximum(span, 1e-9)


def integral(t_s: Array, x: Array) -> Array:
    """Running integral by the trapezoidal rule, 0 at the first row."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(t_s))])


def at(when_s: Array, t_s: Array, area: Array, x: Array) -> Array:
    """The running integral at any time, exact for straight lines; the first value stood before the start."""
    early = np.minimum(when_s - t_s[0], 0.0) * x[0]
    row = np.clip(np.searchsorted(t_s, when_s, side="right") - 1, 0, max(len(t_s) - 2, 0))
    step = np.maximum(np.diff(t_s), 1e-9)
    since = np.clip(when_s - t_s[row], 0.0, step[row])
    return early + area[row] + since * (x[row] + 0.5 * since * np.diff(x)[row] / step[row])


def sampled_window(t_s: Array, x: Array, period_s: float, duty: float) -> Array:
    """Mean over the first `duty` of each period, held until the next."""
    if len(x) < 2:
        return x.copy()
    area = integral(t_s, x)
    open_s = duty * period_s
    begin = np.floor((t_s - open_s) / period_s + 1e-9) * period_s
    return (at(begin + open_s, t_s, area, x) - at(begin, t_s, area, x)) / open_s


def stops(t_s: Array, x: Array, coercivity: float) -> Array:
    """Sum of five stop operators (Prandtl–Ishlinskii) at 0.5 … 1.5 times the coercivity, over the sum of the limits."""
    limits = coercivity * np.array([0.5, 0.75, 1.0, 1.25, 1.5])
    total = np.zeros(len(x))
    moves = np.diff(x, prepend=0.0).tolist()
    for limit in limits.tolist():
        state, out = 0.0, []
        for move in moves:
            state = min(max(state + move, -limit), limit)
            out.append(state)
        total += out
    return total / limits.sum()


def handover(t_s: Array, x: Array, scale: Array, tau_s: float, late: bool) -> Array:
    """Error of a low-pass that keeps the old range's product at the new range's scale: S·LP(x/S) − LP(x).

    A range begins at the row that first tells of it or, `late`, at the row before.
    """
    if len(x) < 2:
        return np.zeros(len(x))
    keep, now, before = ramp(np.diff(t_s), tau_s)
    during = scale[1:] if late else scale[:-1]
    product = recursion(keep, (now * x[1:] + before * x[:-1]) / during, x[0] / scale[0])
    return scale * product - low_pass(t_s, x, tau_s)


def direction_memory(t_s: Array, current_a: Array, gamma: float, capacity_ah: float) -> Array:
    """State of the OCV hysteresis (Plett 2004), −1 … 1, 0 at first: dh/dt = −γ·abs(i)/(3600·Q)·(h + sgn i)."""
    mean = 0.5 * (current_a[1:] + current_a[:-1])
    keep = np.exp(-gamma * np.abs(mean) * np.diff(t_s) / (3600.0 * capacity_ah))
    return recursion(keep, (keep - 1.0) * np.sign(mean), 0.0)


def diffusion(t_s: Array, current_a: Array, tau_s: float) -> Array:
    """Current behind a finite diffusion of 1 Ω, tanh(√(sτ))/√(sτ), as its first eight first-order terms."""
    total = np.zeros(len(current_a))
    for order in range(8):
        root = (order + 0.5) * np.pi
        total += 2.0 / root**2 * low_pass(t_s, current_a, tau_s / root**2, 0.0)
    return total
