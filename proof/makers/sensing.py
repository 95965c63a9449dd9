"""Cases of the sensing chain, made by our own equations (kind d): no result on them alone is a headline.

The equations follow the table of effects and are written anew here, not taken from the tool. What is concealed acts in the
order in which a sensor has its parts: conductor, core, sensitivity, zero, supply, clock, filter, converter, and noise before what
the converter's output does. Each stretch begins after a long rest at its first value: filters settled, core demagnetised.
"""

import pathlib
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import lfilter
from scipy.special import erfcx

from case import COLOURED_TAU_S, FULL_SCALE_A, JUST_VISIBLE, SIGMA_A, Made, Noise, noise, rms, rounded, write_case
from drives import FINE, Stretch, fine_grid, stream, stretches

Values = dict[str, float]
"""Parameters of an effect by their names, which carry the unit."""

RANGE_RATIO = 10.0
STOPS = np.array([0.5, 0.75, 1.0, 1.25, 1.5])
"""Thresholds of the core's stop operators in units of the coercivity."""


class Effect:
    """An effect: how its parameters follow from one number above 0 that makes it larger, and what it does.

    `values(size, random)` draws what is free (signs, time constants) from `random`; `act(y, values, stretch)` gives the
    reading in A on the same grid. `where(values)` names the region in which it acts, if there is one.
    """

    def __init__(self, stage: str, values: Callable, act: Callable, where: Callable | None = None) -> None:
        self.stage, self.values, self.act, self.where = stage, values, act, where


def sign(random: np.random.Generator) -> float:
    """−1 or 1."""
    return float(random.choice([-1.0, 1.0]))


def low_pass(y: np.ndarray, step_s: float, tau_s: float) -> np.ndarray:
    """First order, exact for straight lines between samples, settled at the first one."""
    kept = np.exp(-step_s / tau_s)
    slope = (1.0 - kept) * tau_s / step_s
    return lfilter([1.0 - slope, slope - kept], [1.0, -kept], y - y[0]) + y[0]


def window_means(y: np.ndarray, step_s: float, end_s: np.ndarray, window_s: float) -> np.ndarray:
    """Means of y over windows that end at the given times; straight lines between samples, the first value before them."""
    area = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * step_s)])

    def until(time_s: np.ndarray) -> np.ndarray:
        at = np.clip((time_s / step_s).astype(int), 0, len(y) - 2)
        beyond = time_s - at * step_s
        slope = (y[at + 1] - y[at]) / step_s
        return np.where(time_s < 0.0, y[0] * time_s, area[at] + beyond * (y[at] + 0.5 * slope * beyond))

    return (until(end_s) - until(end_s - window_s)) / window_s


def core_hysteresis(y: np.ndarray, values: Values, _: Stretch) -> np.ndarray:
    """Prandtl–Ishlinskii: the zero lacks the weighted sum of stops that follow the current within ± their thresholds."""
    limits = STOPS * values["coercivity_a"]
    stops = np.zeros(len(limits))
    error = np.empty(len(y))
    moves = np.diff(y, prepend=0.0)
    for row, move in enumerate(moves):
        stops = np.minimum(np.maximum(stops + move, -limits), limits)
        error[row] = stops.sum()
    # A swing to full range and back leaves every stop at its limit.
    return y - values["remanence_a"] / limits.sum() * error


def core_saturation(y: np.ndarray, values: Values, _: Stretch) -> np.ndarray:
    """Fröhlich–Kennelly beyond the knee."""
    knee = values["knee_a"]
    beyond = np.maximum(np.abs(y) - knee, 0.0)
    return np.sign(y) * (np.minimum(np.abs(y), knee) + beyond / (1.0 + beyond / (values["softness"] * knee)))


def supply_ratiometric(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """Zero and sensitivity move with the supply. The zero's 2.5 V stand for 1.25 full scales (2 V of span)."""
    moved = (stretch.supply_v / 5.0 - 1.0) * values["ratio"]
    return y * (1.0 + moved) + 1.25 * FULL_SCALE_A * moved


def self_heating(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """Sensitivity follows the low-passed square of the current."""
    return y * (1.0 + values["tc_per_a2"] * low_pass(y * y, stretch.step_s, values["tau_s"]))


def range_mismatch(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """The large sensor against the small one."""
    return np.where(stretch.range_high > 0.5, values["gain_ratio"] * y + values["offset_a"], y)


def range_handover(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """The multiplier's low-pass keeps the product in the old range's scale.

    On the fine grid, changes where they are. The product's error decays between changes; at a change what the low-pass holds
    is read in the new scale.
    """
    step_s, tau_s = stretch.step_s / FINE, values["tau_s"]
    held = low_pass(y, step_s, tau_s)
    times_s = fine_times(stretch)
    rows = np.searchsorted(times_s, stretch.changes_s)
    error = np.zeros(len(y))
    now = began_s = 0.0
    high = stretch.starts_high
    for row, change_s, end in zip(rows, stretch.changes_s, [*rows[1:], len(y)]):
        high = not high
        # Exact on the straight line from the point before the change to the one after it.
        since_s = change_s - times_s[row - 1]
        slope = (y[row] - y[row - 1]) / step_s
        lagging = held[row - 1] - y[row - 1] + slope * tau_s
        held_then = y[row - 1] + slope * (since_s - tau_s) + lagging * np.exp(-since_s / tau_s)
        now *= np.exp((began_s - change_s) / tau_s)
        now = (RANGE_RATIO if high else 1.0 / RANGE_RATIO) * (now + held_then) - held_then
        began_s = change_s
        error[row:end] = now * np.exp((change_s - times_s[row:end]) / tau_s)
    return y + error


def at_times(y: np.ndarray, stretch: Stretch, time_s: np.ndarray) -> np.ndarray:
    """Values of a series on the fine grid at other times, on the fine grid again."""
    return np.interp(time_s, fine_times(stretch), y)


def fine_times(stretch: Stretch) -> np.ndarray:
    """Times of the fine grid in s."""
    return np.arange((stretch.rows - 1) * FINE + 1) * stretch.step_s / FINE


def sampled_window(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """Mean over the first part of each period, held until the next one. On the fine grid."""
    period_s, open_s = values["period_s"], values["duty"] * values["period_s"]
    times_s = fine_times(stretch)
    newest = np.floor((times_s - open_s) / period_s + 1e-9)
    means = window_means(y, stretch.step_s / FINE, newest * period_s + open_s, open_s)
    return np.where(newest < 0.0, y[0], means)


def dead_band(y: np.ndarray, values: Values, _: Stretch) -> np.ndarray:
    """Small readings count as zero."""
    return np.where(np.abs(y) < values["threshold_a"], 0.0, y)


# What the library does not hold.


def eddy_current(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """A part of the field diffuses through metal: half-order lag 1/(1 + √(jωτ)), step response 1 − erfcx(√(t/τ))."""
    diffused = after_steps(y, stretch, lambda t: 1.0 - erfcx(np.sqrt(t / values["tau_s"])))
    return y + values["share"] * (diffused - (y - y[0]))


def creep(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """The reading goes on with the logarithm of the time since a change."""
    span_s = stretch.rows * stretch.step_s
    whole = np.log1p(span_s / values["tau_s"])
    return y + values["share"] * after_steps(y, stretch, lambda t: np.log1p(t / values["tau_s"]) / whole)


def after_steps(y: np.ndarray, stretch: Stretch, response: Callable) -> np.ndarray:
    """Answers of a linear system to all changes since the first row, from its step response."""
    steps = np.diff(y, prepend=y[0])
    length = 2 * len(y)
    spectrum = np.fft.rfft(steps, length) * np.fft.rfft(response(stretch.t_s + 0.5 * stretch.step_s), length)
    return np.fft.irfft(spectrum, length)[: len(y)]


def missing_codes(y: np.ndarray, values: Values, _: Stretch) -> np.ndarray:
    """A converter that lacks a run of codes: readings within stay at its lower end."""
    return np.where((y > values["from_a"]) & (y < values["from_a"] + values["width_a"]), values["from_a"], y)


def gain_step(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """Sensitivity jumps at some time."""
    return np.where(stretch.t_s >= values["at_share"] * stretch.t_s[-1], values["gain"] * y, y)


def random_walk(y: np.ndarray, values: Values, stretch: Stretch) -> np.ndarray:
    """The zero walks at random, the same walk for the same stretch."""
    of_stretch = int(1e3 * stretch.temp_c[0])
    walk = np.random.default_rng([int(values["walk"]), of_stretch]).standard_normal(len(y)).cumsum()
    return y + values["a_per_root_row"] * walk


EFFECTS: dict[str, Effect] = {
    "stray-field": Effect(
        "rows", lambda k, r: {"coupling": sign(r) * k * 1e-3}, lambda y, v, s: y + v["coupling"] * s.aux_a),
    "core-hysteresis": Effect(
        "rows", lambda k, r: {"remanence_a": k, "coercivity_a": r.uniform(20.0, 50.0)}, core_hysteresis),
    "core-saturation": Effect(
        "rows", lambda k, r: {"knee_a": 600.0 / (1.0 + k), "softness": r.uniform(0.7, 1.5)}, core_saturation,
        lambda v: {"column": "i_ref_a", "from": v["knee_a"], "to": None, "absolute": True}),
    "sensor-self-heating": Effect(
        "rows", lambda k, r: {"tc_per_a2": sign(r) * k * 1e-6, "tau_s": r.uniform(20.0, 80.0)}, self_heating),
    "gain": Effect("rows", lambda k, r: {"gain": 1.0 + sign(r) * k * 1e-3}, lambda y, v, s: y * v["gain"]),
    "gain-temperature": Effect(
        "rows", lambda k, r: {"tc_per_k": sign(r) * k * 1e-3},
        lambda y, v, s: y * (1.0 + v["tc_per_k"] * (s.temp_c - 25.0))),
    "offset": Effect("rows", lambda k, r: {"offset_a": sign(r) * k}, lambda y, v, s: y + v["offset_a"]),
    "offset-temperature": Effect(
        "rows", lambda k, r: {"tc_a_per_k": sign(r) * k * 0.1}, lambda y, v, s: y + v["tc_a_per_k"] * (s.temp_c - 25.0)),
    "supply-ratiometric": Effect("rows", lambda k, r: {"ratio": sign(r) * k * 0.01}, supply_ratiometric),
    "range-mismatch": Effect(
        "rows", lambda k, r: {"gain_ratio": 1.0 + sign(r) * k * 1e-3, "offset_a": sign(r) * k * 0.1}, range_mismatch,
        lambda v: {"column": "range_high", "from": 0.5, "to": None, "absolute": False}),
    "eddy-current": Effect("rows", lambda k, r: {"share": k * 1e-3, "tau_s": r.uniform(0.5, 3.0)}, eddy_current),
    "creep": Effect("rows", lambda k, r: {"share": sign(r) * k * 1e-3, "tau_s": r.uniform(1.0, 3.0)}, creep),
    "aux-squared": Effect(
        "rows", lambda k, r: {"per_a": sign(r) * k * 1e-4}, lambda y, v, s: y + v["per_a"] * s.aux_a**2),
    "quadratic": Effect(
        "rows", lambda k, r: {"per_a": sign(r) * k * 1e-5}, lambda y, v, s: y + v["per_a"] * y**2),
    # Positive: one that falls short would be a saturating core.
    "cubic": Effect("rows", lambda k, r: {"per_a2": k * 1e-8}, lambda y, v, s: y + v["per_a2"] * y**3),
    "gain-step": Effect(
        "rows", lambda k, r: {"gain": 1.0 + sign(r) * k * 1e-3, "at_share": r.uniform(0.4, 0.6)}, gain_step),
    "random-walk": Effect(
        "rows", lambda k, r: {"a_per_root_row": k * 0.01, "walk": float(r.integers(2**31))}, random_walk),
    "range-handover": Effect("fine", lambda k, r: {"tau_s": k * 0.01}, range_handover),
    "delay": Effect(
        "fine", lambda k, r: {"delay_s": k * 0.01}, lambda y, v, s: at_times(y, s, fine_times(s) - v["delay_s"])),
    "clock-skew": Effect(
        "fine", lambda k, r: {"skew_ppm": sign(r) * k * 10.0},
        lambda y, v, s: at_times(y, s, fine_times(s) / (1.0 + v["skew_ppm"] * 1e-6))),
    "lag": Effect("fine", lambda k, r: {"tau_s": k * 0.01}, lambda y, v, s: low_pass(y, s.step_s / FINE, v["tau_s"])),
    "moving-average": Effect(
        "fine", lambda k, r: {"window_s": k * 0.01},
        lambda y, v, s: window_means(y, s.step_s / FINE, fine_times(s), v["window_s"])),
    "sampled-window": Effect(
        "fine", lambda k, r: {"period_s": k * 0.01, "duty": r.uniform(0.3, 0.7)}, sampled_window),
    "hum": Effect(
        "output", lambda k, r: {"frequency_hz": r.uniform(0.3, 4.7), "amplitude_a": k},
        lambda y, v, s: y + v["amplitude_a"] * np.sin(2.0 * np.pi * v["frequency_hz"] * s.t_s)),
    "missing-codes": Effect(
        "output", lambda k, r: {"from_a": r.uniform(5.0, 20.0), "width_a": k}, missing_codes,
        lambda v: {"column": "i_ref_a", "from": v["from_a"], "to": v["from_a"] + v["width_a"], "absolute": False}),
    "clipping": Effect(
        "output", lambda k, r: {"high_a": FULL_SCALE_A / (1.0 + k)}, lambda y, v, s: np.minimum(y, v["high_a"]),
        lambda v: {"column": "i_ref_a", "from": v["high_a"], "to": None, "absolute": False}),
    "dead-band": Effect(
        "output", lambda k, r: {"threshold_a": k}, dead_band,
        lambda v: {"column": "i_ref_a", "from": 0.0, "to": v["threshold_a"], "absolute": True}),
    "quantisation": Effect("output", lambda k, r: {"step_a": k}, lambda y, v, s: rounded(y, v["step_a"])),
}
"""All effects, in the order in which they act. What acts at the output acts on the noise too."""

LIBRARY = {
    "offset", "gain", "offset-temperature", "gain-temperature", "supply-ratiometric", "core-hysteresis", "core-saturation",
    "clipping", "lag", "moving-average", "delay", "clock-skew", "hum", "quantisation", "dead-band", "range-handover",
    "range-mismatch", "sensor-self-heating", "stray-field", "sampled-window",
}
"""Effects that the tool knows; the others are there to see what it says of what it cannot know."""

PARTLY_TRUE = {
    "gain-step": ("gain", "the sensitivity is wrong for a part of the time"),
    "random-walk": ("offset", "a walk has a mean"),
    "aux-squared": ("offset", "a square has a mean"),
}
"""Of effects outside the library: a name within it that is true of the data too, and why."""

ONE_SIZE = ["core-saturation", "clipping", "sensor-self-heating", "quantisation", "core-hysteresis"]
INSEPARABLE = {
    ("temperature", "offset-temperature"): (["offset"], [], "at one temperature a drift of the zero is a zero error"),
    ("temperature", "gain-temperature"): (["gain"], [], "at one temperature a drift of the sensitivity is a gain"),
    ("supply", "supply-ratiometric"): (["offset"], ["gain"], "at one supply its zero is an offset, its sensitivity a gain"),
    ("aux", "stray-field"): (["offset"], [], "a constant neighbour adds a constant"),
    ("range", "range-mismatch"): (["gain", "offset"], ["gain", "offset"], "in one range it is a gain and an offset"),
    ("square", "gain"): (ONE_SIZE, [], "one size of current only: any error in proportion, any staircase, any memory"),
    ("square", "core-saturation"): (["gain", *ONE_SIZE[1:]], [], "as for a gain on this drive"),
}
"""What stands still (or the drive), and the effect: names that are as right, names that are true beside, and why."""


MASKED_DRAWS = 8


def chain(current: Stretch, hidden: list[tuple[str, Values]], noise_a: np.ndarray | float = 0.0) -> np.ndarray:
    """The reading in A with the hidden effects and the given noise."""
    parts = dict(hidden)

    def act(y: np.ndarray, stage: str) -> np.ndarray:
        for name, effect in EFFECTS.items():
            if name in parts and effect.stage == stage:
                y = effect.act(y, parts[name], current)
        return y

    y = act(current.current_a, "rows")
    if any(EFFECTS[name].stage == "fine" for name in parts):
        y = act(fine_grid(y), "fine")[::FINE]
    return act(y + noise_a, "output")


def sized(stretch: Stretch, name: str, strength: float, noise: Noise, random: Callable) -> Values:
    """Parameters that move the reading by 0.3·strength·SIGMA_A, rms over the stretch."""
    target = JUST_VISIBLE * strength * SIGMA_A
    effect = EFFECTS[name]
    if name == "quantisation" and noise.step_a > 0.0:
        # What is designed as a step already counts from there.
        return effect.values(float(np.sqrt(noise.step_a**2 + 12.0 * target**2)), random())

    def excess(log_size: float) -> float:
        values = effect.values(float(np.exp(log_size)), random())
        return np.log(rms(chain(stretch, [(name, values)]) - stretch.current_a) + 1e-12) - np.log(target)

    low = high = 0.0
    while excess(low) > 0.0 and low > -25.0:
        low -= 1.5
    while excess(high) < 0.0 and high < 25.0:
        high += 1.5
    if excess(low) > 0.0 or excess(high) < 0.0:
        raise ValueError(f"{name}: strength {strength:g} cannot be had on this drive")
    return effect.values(float(np.exp(brentq(excess, low, high, xtol=1e-3))), random())


def hidden_effects(case: dict, stretch: Stretch, noise: Noise) -> list[tuple[str, Values]]:
    """The concealed effects with their parameters.

    With `options.masked` their free signs and time constants are those, of MASKED_DRAWS, with which they hide one another most.
    """
    for wanted in case["effects"]:
        if wanted["id"] not in EFFECTS:
            raise ValueError(f"effects: expected one of {', '.join(sorted(EFFECTS))}, found {wanted['id']!r}")

    def drawn(draw: int) -> list[tuple[str, Values]]:
        return [
            (one["id"], sized(stretch, one["id"], one["strength"], noise, lambda: stream(case, f"{one['id']} {draw}")))
            for one in case["effects"]
        ]

    tried = [drawn(draw) for draw in range(MASKED_DRAWS if case["options"].get("masked") else 1)]
    return min(tried, key=lambda hidden: rms(chain(stretch, hidden) - stretch.current_a))


EDGES = {"lag": ("tau_s", 1.0), "moving-average": ("window_s", 2.0), "delay": ("delay_s", 1.0)}
"""Effects that delay: the parameter, in units of the mean delay."""
SAME, UNSURE = 1.0, 3.3
"""Who knows both shapes and the noise and has to choose errs in 31 % of cases at a distance of 1, in 5 % at 3.3."""


def distance(difference_a: np.ndarray, step_s: float, noise: Noise) -> float:
    """How many standard deviations two readings are apart for who knows the noise's spectrum (matched filter)."""
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(len(difference_a)))
    kept = np.exp(-step_s / COLOURED_TAU_S)
    density = noise.white_a**2 + noise.step_a**2 / 12.0 + noise.coloured_a**2 * (1.0 - kept**2) / np.abs(1.0 - kept * turn) ** 2
    energy = np.abs(np.fft.rfft(difference_a)) ** 2 / np.maximum(density, 1e-9)
    return float(np.sqrt(2.0 * energy.sum() / len(difference_a)))


def edge_rivals(stretch: Stretch, name: str, values: Values, noise: Noise) -> dict[str, float]:
    """Distance of the others of EDGES, each with the parameter that comes nearest; on coarse rows it can be none."""
    reading = chain(stretch, [(name, values)])
    own, multiple = EDGES[name]

    def nearest(rival: str) -> float:
        parameter, factor = EDGES[rival]
        mean_s = values[own] / multiple * factor

        def away(share: float) -> float:
            return distance(reading - chain(stretch, [(rival, {parameter: share * mean_s})]), stretch.step_s, noise)

        return float(minimize_scalar(away, bounds=(0.5, 1.5), method="bounded", options={"xatol": 1e-3}).fun)

    return {rival: nearest(rival) for rival in EDGES if rival != name}


def edge_names(stretch: Stretch, name: str, values: Values, noise: Noise) -> tuple[list[str], list[list[str]], str]:
    """Names that are as right for an effect of EDGES, pairs that only a class does justice to, and why."""
    rivals = edge_rivals(stretch, name, values, noise)
    told = ", ".join(f"{rival} {away:.2g}" for rival, away in rivals.items())
    why = f"distance of the nearest {told} standard deviations, for who knows shapes and noise"
    return (
        [name, *(rival for rival, away in rivals.items() if away < SAME)],
        [[name, rival] for rival, away in rivals.items() if away < UNSURE],
        why,
    )


def truth(case: dict, hidden: list[tuple[str, Values]], stretch: Stretch, noise: Noise) -> dict:
    """What is right to say of the case."""
    required, allowed, classes, why = [], [], [], []
    still = [*case["options"].get("constant", []), case["drive"]]
    for name, values in hidden:
        if name in EDGES:
            names, pairs, reason = edge_names(stretch, name, values, noise)
            required.append(names)
            classes += pairs
            why.append(reason)
            continue
        if name not in LIBRARY:
            why.append(f"{name} is not in the library")
            if name in PARTLY_TRUE:
                allowed.append(PARTLY_TRUE[name][0])
                why.append(PARTLY_TRUE[name][1])
            continue
        equal = [INSEPARABLE[what, name] for what in still if (what, name) in INSEPARABLE]
        others = [other for one in equal for other in one[0]]
        required.append([name, *others])
        allowed += [other for one in equal for other in one[1]]
        why += [one[2] for one in equal]
        classes += [[name, *others]] if others else []
    places = [EFFECTS[name].where(values) for name, values in hidden if EFFECTS[name].where]
    return {
        "kind": "d",
        "maker": "numpy/scipy, own equations",
        "effects": [{"id": name, "parameters": values} for name, values in hidden],
        "required": required,
        "allowed": allowed,
        "class_ids": classes,
        "why": "; ".join(why),
        "where": places[0] if len(hidden) == 1 and places else None,
    }


def make(case: dict, out: pathlib.Path) -> None:
    """Writes the case's files."""
    fitted, holdout = stretches(case)
    stated = noise(case["noise"])
    hidden = hidden_effects(case, fitted, stated)
    # A coarser step takes the place of the designed one.
    step_a = 0.0 if any(name == "quantisation" for name, _ in hidden) else stated.step_a

    def made(stretch: Stretch, purpose: str) -> Made:
        noise_a = stated.sample(stream(case, purpose), stretch.rows, stretch.step_s)
        return Made(stretch, rounded(chain(stretch, hidden, noise_a), step_a), chain(stretch, hidden))

    write_case(out, made(fitted, "noise"), made(holdout, "noise held out"), stated, truth(case, hidden, fitted, stated))
