"""The dictionary of the regression methods: what each effect of the library adds to the reading, by first order.

An entry is one effect at one value of what it is not linear in (a time constant, a threshold). Values lie on a grid that
follows from the recording; a method may move one within `low` … `high`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

import filters
from series import Series

Array = np.ndarray
Build = Callable[[Series, float], Array]

# Scale of the large range over the small one, as the board has it.
RANGE_RATIO = 10.0
# 2.5 V over the 2 V from zero to full scale: what the zero of a ratiometric sensor stands for, in full scales.
HALF_SUPPLY_OVER_SPAN = 1.25
ZERO_C_IN_K = 273.15
# RT/F at 25 °C: 8.314463 J/(mol·K)·298.15 K over 96485.332 C/mol.
THERMAL_V = 0.025693
# Arrhenius temperature of the resistance of usual lithium-ion cells, 1500 … 4000 K.
USUAL_B_K = 2000.0
# States of charge that a recording has to pass, as twin's has, for a rise near full to be asked for.
FULL_WITH_EMPTY = (0.3, 0.8)
# Entries of one effect in one model: one, but several RC branches and lines, an upper and a lower rail, a rise at either end of the
# charge.
MOST_OF_ONE = {"polarisation": 3, "hum": 3, "clipping": 2, "resistance-soc": 2}


@dataclass(frozen=True)
class Entry:
    """One effect at one value. `build` gives rows × columns in the unit of the reading."""

    id: str
    build: Build
    parameter: str = ""
    value: float = 0.0
    low: float = 0.0
    high: float = 0.0
    # Names of the coefficients, and what turns them off.
    coefficients: tuple[tuple[str, float], ...] = (("coefficient", 0.0),)
    # Physics allows a positive coefficient only.
    positive: bool = False

    @property
    def tuned(self) -> bool:
        """Has it a value that is not linear?"""
        return self.high > self.low

    def moved(self, value: float) -> Entry:
        """The same effect at another value."""
        return replace(self, value=value)

    def columns(self, series: Series) -> Array:
        """Its columns for a recording, rows × columns."""
        out = self.build(series, self.value)
        return out[:, None] if out.ndim == 1 else out

    def described(self, coefficients: Array) -> dict[str, float]:
        """Its parameters by name."""
        out = {name: float(off + c) for (name, off), c in zip(self.coefficients, coefficients)}
        return out | {self.parameter: float(self.value)} if self.parameter else out


def spread(effect: str, build: Build, parameter: str, grid: Array, **more: object) -> list[Entry]:
    """One entry for each value of an ascending grid; each may move half-way (geometrically) to its neighbours."""
    grid = np.asarray(grid, float)
    if len(grid) == 1:
        return [Entry(effect, build, parameter, grid[0], grid[0] / 1.5, grid[0] * 1.5, **more)]
    edges = np.sqrt(grid[1:] * grid[:-1])
    low = np.concatenate([[grid[0] ** 2 / edges[0]], edges])
    high = np.concatenate([edges, [grid[-1] ** 2 / edges[-1]]])
    return [Entry(effect, build, parameter, v, a, b, **more) for v, a, b in zip(grid, low, high)]


def times(low_s: float, high_s: float, ratio: float) -> Array:
    """Logarithmic grid in s, neighbours about `ratio` apart."""
    count = max(2, int(np.ceil(np.log(high_s / low_s) / np.log(ratio))) + 1)
    return np.geomspace(low_s, high_s, count)


def dictionary(recording: Series) -> list[Entry]:
    """All entries that this recording's columns allow; nuisances (uncertain design numbers) are not in it."""
    entries = battery_entries(recording) if recording.kind == "battery" else sensor_entries(recording)
    return [entry for entry in entries if usable(entry, recording)]


def usable(entry: Entry, recording: Series) -> bool:
    """Does it say anything at all on this recording?"""
    columns = entry.columns(recording)[recording.valid]
    return bool(np.isfinite(columns).all() and (np.abs(columns).max(axis=0) > 1e-12).all())


def nuisances(series: Series) -> Array:
    """Columns that stand for stated uncertainty of the design (battery): always in a model, never named."""
    columns = np.zeros((len(series.x), 0))
    if series.battery is None:
        return columns
    if not series.battery.resistance_exact:
        columns = np.column_stack([columns, -series.x])
    if not series.battery.soc_exact:
        columns = np.column_stack([columns, series.other["slope_v"]])
    if not series.battery.current_zero_exact:
        # Each recording has a zero of its own: what was found in one says nothing of another.
        columns = np.column_stack([columns, parasitic(series, 0.0) * series.fitted])
    return columns


# Sensing chain ------------------------------------------------------------------------------------------------------


def sensor_entries(recording: Series) -> list[Entry]:
    """Effects that a current or power reading can show."""
    return [
        *drift_entries(recording),
        *shape_entries(recording),
        *timing_entries(recording),
        *line_entries(recording),
        *range_entries(recording),
    ]


def drift_entries(recording: Series) -> list[Entry]:
    """Zero and sensitivity, and what moves them."""
    out = [
        Entry("offset", lambda s, _: np.ones(len(s.x)), coefficients=(("offset_a", 0.0),)),
        Entry("gain", lambda s, _: s.x, coefficients=(("gain", 1.0),)),
    ]
    if "temperature_c" in recording.other:
        out += [
            Entry("offset-temperature", lambda s, _: warmth(s), coefficients=(("tc_a_per_k", 0.0),)),
            Entry("gain-temperature", lambda s, _: s.x * warmth(s), coefficients=(("tc_per_k", 0.0),)),
        ]
    if "supply_v" in recording.other:
        out.append(supply_entry(recording))
    if "aux" in recording.other:
        out.append(Entry("stray-field", lambda s, _: s.other["aux"], coefficients=(("coupling", 0.0),)))
    slow = times(20 * recording.step_s, recording.span_s / 3, 3.0)
    out += spread("sensor-self-heating", self_heating, "tau_s", slow, coefficients=(("tc_per_a2", 0.0),))
    return out


def warmth(series: Series) -> Array:
    """Kelvin above 25 °C."""
    return series.other["temperature_c"] - 25.0


def supply_entry(recording: Series) -> Entry:
    """One column where the full scale is stated, else zero and sensitivity each its own."""
    if recording.full_scale > 0:
        return Entry("supply-ratiometric", supply, coefficients=(("ratio", 0.0),))
    apart = (("zero_a", 0.0), ("ratio", 0.0))
    return Entry("supply-ratiometric", supply_apart, coefficients=apart)


def supply(series: Series, _: float) -> Array:
    """(Vc/5 − 1)·(i + zero)."""
    return (series.other["supply_v"] / 5.0 - 1.0) * (series.x + HALF_SUPPLY_OVER_SPAN * series.full_scale)


def supply_apart(series: Series, _: float) -> Array:
    """(Vc/5 − 1) and (Vc/5 − 1)·i."""
    moved = series.other["supply_v"] / 5.0 - 1.0
    return np.column_stack([moved, moved * series.x])


def self_heating(series: Series, tau_s: float) -> Array:
    """i·LP(i²)."""
    return series.x * filters.by_segment(filters.low_pass, series.segments, series.t_s, series.x**2, tau_s)


def shape_entries(recording: Series) -> list[Entry]:
    """What depends on the size of the signal."""
    x = recording.x
    largest = float(np.abs(x).max())
    out = spread("core-hysteresis", hysteresis, "coercivity_a", largest * np.geomspace(0.02, 0.4, 5), positive=True)
    out += spread("core-saturation", saturation, "knee_a", largest * np.array([0.3, 0.45, 0.6, 0.75, 0.88]), positive=True)
    for sign, name in ((1.0, "high_a"), (-1.0, "low_a")):
        end = float((sign * x).max())
        if end > 0.05 * largest:
            build = clip_high if sign > 0 else clip_low
            grid = end * np.array([0.4, 0.55, 0.7, 0.8, 0.88, 0.94, 0.98])
            out += spread("clipping", build, name, grid, positive=True)
    out += spread("dead-band", dead_band, "threshold_a", largest * np.geomspace(0.003, 0.3, 8), positive=True)
    return out + step_entries(recording)


def hysteresis(series: Series, coercivity: float) -> Array:
    """Zero error of a core that was swung to its end and back: minus the sum of stops."""
    return -filters.by_segment(filters.stops, series.segments, series.t_s, series.x, coercivity)


def saturation(series: Series, knee: float) -> Array:
    """What is missing beyond the knee, by first order in 1/softness: −sgn(i)·e²/knee."""
    return -np.sign(series.x) * np.maximum(np.abs(series.x) - knee, 0.0) ** 2 / knee


def clip_high(series: Series, limit: float) -> Array:
    """What is cut off above."""
    return -np.maximum(series.x - limit, 0.0)


def clip_low(series: Series, limit: float) -> Array:
    """What is cut off below −limit."""
    return np.maximum(-series.x - limit, 0.0)


def dead_band(series: Series, threshold: float) -> Array:
    """What is missing within the band."""
    return np.where(np.abs(series.x) < threshold, -series.x, 0.0)


def step_entries(recording: Series) -> list[Entry]:
    """Quantisation: the step that the readings show, if they do, and steps that could have made the residual."""
    reading = recording.reading[recording.valid]
    rms = float(np.std(recording.residual[recording.valid]))
    grid = list(rms * np.sqrt(12.0) * np.array([0.35, 0.6, 1.0]))
    shown = shown_step(reading)
    if shown > max(1.5 * recording.resolution, 1e-3 * rms):
        grid.append(shown)
    return spread("quantisation", quantised, "step_a", np.unique(grid), positive=True)


def shown_step(reading: Array) -> float:
    """The usual distance of neighbouring values, if the readings take few values; else 0."""
    values = np.unique(np.round(reading, 9))
    if len(values) < 3 or len(values) > 0.5 * len(reading):
        return 0.0
    return float(np.median(np.diff(values)))


def quantised(series: Series, step: float) -> Array:
    """Error of rounding to the step, its mean over the stated noise (Fourier series of the saw-tooth)."""
    if series.noise < 0.02 * step:
        return np.round(series.x / step) * step - series.x
    out = np.zeros(len(series.x))
    for order in range(1, 40):
        damping = np.exp(-2.0 * (np.pi * order * series.noise / step) ** 2)
        if damping < 1e-4:
            break
        out += (-1) ** order * damping * step / (np.pi * order) * np.sin(2 * np.pi * order * series.x / step)
    return out


def timing_entries(recording: Series) -> list[Entry]:
    """What depends on the past of the signal."""
    step = recording.step_s
    last = max(min(recording.span_s / 8, 500 * step), 4 * step)
    out = spread("lag", lag, "tau_s", times(step / 12, last, 2.2), positive=True)
    out += spread("moving-average", average, "window_s", times(step / 6, last, 2.2), positive=True)
    out += spread("delay", delay, "delay_s", times(step / 20, max(last / 4, step), 2.2))
    # A clock that is set anew has no time over which an error could grow.
    for build in (skew_fast, skew_slow) if np.all(np.diff(recording.t_s) >= 0) else ():
        out += spread("clock-skew", build, "skew_ppm", 1e6 / elapsed(recording) * times(step / 8, 5 * step, 2.0), positive=True)
    for duty in (0.2, 0.5, 0.8):
        build = window_of(duty)
        grid = times(2 * step, max(last / 4, 4 * step), 2.0)
        out += spread("sampled-window", build, "period_s", grid, positive=True)
    return out


def lag(series: Series, tau_s: float) -> Array:
    """LP(i) − i."""
    return filters.by_segment(filters.low_pass, series.segments, series.t_s, series.x, tau_s) - series.x


def average(series: Series, window_s: float) -> Array:
    """Mean over the window − i."""
    return filters.by_segment(filters.boxcar, series.segments, series.t_s, series.x, window_s) - series.x


def delay(series: Series, delay_s: float) -> Array:
    """i(t − delay) − i."""
    return filters.by_segment(filters.shifted, series.segments, series.t_s, series.x, delay_s) - series.x


def elapsed(series: Series) -> float:
    """From the clock's zero to the last row, in s."""
    return float(np.abs(series.t_s).max())


def skew_fast(series: Series, ppm: float) -> Array:
    """i(t/(1 + skew)) − i: a clock that runs fast reads the past."""
    past = [np.interp(series.t_s[part] / (1.0 + 1e-6 * ppm), series.t_s[part], series.x[part]) for part in series.segments]
    return np.concatenate(past) - series.x


def skew_slow(series: Series, ppm: float) -> Array:
    """The same for a slow clock, `ppm` by its amount."""
    return skew_fast(series, -ppm)


def window_of(duty: float) -> Build:
    """A sampled window of one duty."""

    def build(series: Series, period_s: float) -> Array:
        """Mean over the first part of each period, held, − i."""
        return filters.by_segment(filters.sampled_window, series.segments, series.t_s, series.x, period_s, duty) - series.x

    return build


def line_entries(recording: Series) -> list[Entry]:
    """Hum: mains lines folded by the sampling rate, and up to three lines that stand out of the residual's spectrum."""
    part = max(recording.segments, key=lambda p: p.stop - p.start)
    step = recording.step_s
    t_s = np.arange(recording.t_s[part][0], recording.t_s[part][-1], step)
    known = recording.valid[part]
    if len(t_s) < 64 or known.sum() < 64:
        return []
    residual = np.interp(t_s, recording.t_s[part][known], recording.residual[part][known])
    power = np.abs(np.fft.rfft((residual - residual.mean()) * np.hanning(len(residual)))) ** 2
    width = 1.0 / (len(t_s) * step)
    # Power over that of its neighbourhood: the median of an exponential distribution is ln 2 of its mean.
    ratio = power / np.maximum(median_filter(power, 101, mode="nearest") / np.log(2.0), 1e-300)
    ratio[:4] = ratio[-1] = 0.0
    frequencies = []
    for _ in range(3):
        peak = int(np.argmax(ratio))
        # One in a hundred spectra of noise has such a peak anywhere.
        if ratio[peak] < np.log(len(power) / 0.01):
            break
        frequencies.append(peak * width)
        ratio[max(peak - 3, 0) : peak + 4] = 0.0
    for mains in (50.0, 60.0, 100.0, 120.0):
        folded = abs(mains - round(mains * step) / step)
        if folded > 4 * width:
            frequencies.append(folded)
    two = (("amplitude_sin_a", 0.0), ("amplitude_cos_a", 0.0))
    return [Entry("hum", line, "frequency_hz", f, f - width, f + width, two) for f in frequencies]


def line(series: Series, frequency_hz: float) -> Array:
    """Sine and cosine."""
    angle = 2 * np.pi * frequency_hz * series.t_s
    return np.column_stack([np.sin(angle), np.cos(angle)])


def range_entries(recording: Series) -> list[Entry]:
    """What follows the range flag."""
    if "range_high" not in recording.other or np.ptp(recording.other["range_high"]) == 0:
        return []
    two = (("offset_a", 0.0), ("gain_ratio", 1.0))
    grid = times(recording.step_s / 10, 30 * recording.step_s, 2.5)
    return [
        Entry("range-mismatch", mismatch, coefficients=two),
        *spread("range-handover", handover_of(False), "tau_s", grid, positive=True),
        *spread("range-handover", handover_of(True), "tau_s", grid, positive=True),
    ]


def mismatch(series: Series, _: float) -> Array:
    """Zero and sensitivity of the large range only."""
    return np.column_stack([series.other["range_high"], series.other["range_high"] * series.x])


def handover_of(late: bool) -> Build:
    """A range that begins at its first row, or (late) at the row before."""

    def build(series: Series, tau_s: float) -> Array:
        """Memory of the old range."""
        scale = np.where(series.other["range_high"] > 0.5, RANGE_RATIO, 1.0)
        out = np.empty(len(series.x))
        for part in series.segments:
            out[part] = filters.handover(series.t_s[part], series.x[part], scale[part], tau_s, late)
        return out

    return build


# Battery ------------------------------------------------------------------------------------------------------------


def battery_entries(recording: Series) -> list[Entry]:
    """Effects that a cell's voltage can show."""
    step, span = recording.step_s, recording.span_s
    out = [
        Entry("coulombic-efficiency", lost_charge, coefficients=(("lost_share", 0.0),), positive=True),
        Entry("capacity", capacity, coefficients=(("relative_change", 0.0),)),
    ]
    out += spread("polarisation", polarisation, "tau_s", times(step, max(span / 2, 4 * step), 2.5), positive=True)
    exchange = np.geomspace(0.02, 2.0, 7) * np.abs(recording.x).max()
    out += spread("charge-transfer", charge_transfer, "i0_a", exchange, coefficients=(("share", 0.0),), positive=True)
    slow = times(max(20 * step, 5.0), max(span, 100 * step), 2.5)
    out += spread("diffusion", diffusion, "tau_s", slow, coefficients=(("r_ohm", 0.0),), positive=True)
    gammas, knees = np.geomspace(3, 3000, 7), np.array([0.1, 0.2, 0.35, 0.6])
    out += spread("ocv-hysteresis", ocv_hysteresis, "gamma", gammas, coefficients=(("m_v", 0.0),), positive=True)
    out += spread("resistance-soc", soc_resistance, "knee_soc", knees, coefficients=(("rise", 0.0),), positive=True)
    if (soc := recording.other["soc"]).min() <= FULL_WITH_EMPTY[0] and soc.max() >= FULL_WITH_EMPTY[1]:
        knees_full = np.array([0.7, 0.85, 0.92, 0.96])
        out += spread(
            "resistance-soc", full_resistance, "knee_full_soc", knees_full, coefficients=(("rise_full", 0.0),), positive=True
        )
    if recording.battery.current_zero_exact:
        # One that is uncertain is a nuisance.
        out.insert(1, Entry("parasitic-load", parasitic, coefficients=(("load_a", 0.0),), positive=True))
    if recording.battery.resistance_exact and recording.battery.resistance_ohm:
        # One that is uncertain is a nuisance.
        out.append(Entry("resistance", lambda s, _: -ohms(s) * s.x, coefficients=(("scale", 1.0),)))
    if "temperature_c" in recording.other:
        out += [
            Entry("resistance-temperature", arrhenius, positive=True),
            Entry("entropic", lambda s, _: s.battery.cells * warmth(s), coefficients=(("v_per_k", 0.0),)),
        ]
    if not recording.battery.warmth_recorded:
        # Where the cell's own temperature is recorded, it holds the warming.
        warm = times(max(10 * step, 10.0), max(span / 2, 100.0), 3.0)
        out += spread("cell-self-heating", cell_heating, "tau_s", warm, positive=True)
    return out


def ohms(series: Series) -> float:
    """Ohmic resistance of what is compared, in Ω; 1 Ω where the design states none."""
    return (series.battery.resistance_ohm or 1.0) * series.battery.cells


def lost_charge(series: Series, _: float) -> Array:
    """Voltage by the charge that did not come in: −dOCV/dSoC·(charge put in)/Q."""
    put_in = count_charge(series, np.maximum(-series.x, 0.0))
    return -series.other["slope_v"] * put_in


def parasitic(series: Series, _: float) -> Array:
    """Voltage by 1 A more that flows all the time."""
    return -series.other["slope_v"] * count_charge(series, np.ones(len(series.x)))


def capacity(series: Series, _: float) -> Array:
    """Voltage by a capacity that is larger by itself: the change of SoC falls away."""
    return -series.other["slope_v"] * (series.other["soc"] - series.other["soc"][0])


def count_charge(series: Series, current_a: Array) -> Array:
    """Charge in capacities, also over gaps."""
    steps = np.maximum(np.diff(series.t_s), 0.0)
    moved = np.cumsum(0.5 * (current_a[1:] + current_a[:-1]) * steps)
    return np.concatenate([[0.0], moved]) / (3600.0 * series.battery.capacity_ah)


def polarisation(series: Series, tau_s: float) -> Array:
    """−LP(i), from rest."""
    return -filters.by_segment(filters.low_pass, series.segments, series.t_s, series.x, tau_s, 0.0)


def charge_transfer(series: Series, exchange_a: float) -> Array:
    """(2RT/F)·(x − asinh x), x = i/(2·i0), at 25 °C: what the slope at small currents promises too much."""
    x = series.x / (2.0 * exchange_a)
    return series.battery.cells * 2.0 * THERMAL_V * (x - np.arcsinh(x))


def diffusion(series: Series, tau_s: float) -> Array:
    """Current behind a finite diffusion, from rest."""
    return -filters.by_segment(filters.diffusion, series.segments, series.t_s, series.x, tau_s)


def ocv_hysteresis(series: Series, gamma: float) -> Array:
    """State of the hysteresis."""
    capacity_ah = series.battery.capacity_ah
    return filters.by_segment(filters.direction_memory, series.segments, series.t_s, series.x, gamma, capacity_ah)


def soc_resistance(series: Series, knee: float) -> Array:
    """−R·i·(1 − SoC/knee) below the knee."""
    return -ohms(series) * series.x * np.maximum(1.0 - series.other["soc"] / knee, 0.0)


def full_resistance(series: Series, knee: float) -> Array:
    """−R·i·(SoC − knee)/(1 − knee) above the knee."""
    return -ohms(series) * series.x * np.maximum((series.other["soc"] - knee) / (1.0 - knee), 0.0)


def arrhenius(series: Series, _: float) -> Array:
    """−R·i·(exp(B·(1/T − 1/298.15)) − 1) at the B of a usual cell."""
    kelvin = series.other["temperature_c"] + ZERO_C_IN_K
    return -ohms(series) * series.x * np.expm1(USUAL_B_K * (1.0 / kelvin - 1.0 / 298.15))


def cell_heating(series: Series, tau_s: float) -> Array:
    """R·i·LP(R·i²)·B/298²: the resistance falls by the Arrhenius slope of a usual cell, for 1 K/W."""
    losses = ohms(series) * series.x**2
    warm = filters.by_segment(filters.low_pass, series.segments, series.t_s, losses, tau_s, 0.0)
    return ohms(series) * series.x * warm * USUAL_B_K / 298.15**2
