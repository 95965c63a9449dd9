"""What all cases of a cell have in common: the drive, noise, the model as designed, the files, the truth."""

import dataclasses
import functools
import json
import pathlib

import numpy as np
from scipy.signal import lfilter

from case import JUST_VISIBLE, rms
from drives import RECORDINGS, coloured, stream

SIGMA_V = 0.001
"""Noise of the voltage in V, rms, whatever its kind. Strength 1 moves the voltage by JUST_VISIBLE of it, rms."""
COLOURED_TAU_S = 20.0
WHITE_BESIDE = 0.3
"""White noise beside the coloured one, and before the converter's step in units of that step."""
STEP_S = 0.5
"""Time between rows; the current goes in straight lines between them."""
REFERENCE_C, ZERO_CELSIUS_K = 25.0, 273.15
FEWEST, MOST = 200, 8000
"""Rows of a case: US06 empties the cell soon after the most."""
TRIES = 8
"""So often the size of an effect is tried."""
OTHER_DRIVE = {"us06": "hwfet", "hwfet": "us06", "hppc": "us06"}
STEADY_A = 0.05
"""A current that changes by less from row to row is steady."""
LONGEST_STEADY_S = 120.0
"""Longer rests and discharges of the pulse test are cut to this."""

Ladder = tuple[tuple[float, float], ...]
"""Pairs of resistance in Ω and time constant in s."""


def drive_a(drive: str, rows: int, start_s: float = 0.0) -> np.ndarray:
    """Current of the Panasonic cell in A, positive = discharge, on rows STEP_S apart; the cycle repeats if the file ends."""
    if drive not in OTHER_DRIVE:
        raise ValueError(f"drive: expected one of {', '.join(OTHER_DRIVE)}, found {drive!r}")
    if not FEWEST <= rows <= MOST:
        raise ValueError(f"rows: expected {FEWEST} to {MOST}, found {rows}")
    known_s, known_a = _recorded(drive)
    t_s = start_s + np.arange(rows) * STEP_S
    return np.interp(np.mod(t_s, known_s[-1]), known_s, known_a)


@functools.cache
def _recorded(drive: str) -> tuple[np.ndarray, np.ndarray]:
    table = np.genfromtxt(RECORDINGS / f"panasonic-18650pf/25c-{drive}.csv", delimiter=",", names=True, usecols=("t_s", "i_ref_a"))
    if drive != "hppc":
        return table["t_s"], table["i_ref_a"]
    even_s = np.arange(0.0, table["t_s"][-1], STEP_S)
    even_a = np.interp(even_s, table["t_s"], table["i_ref_a"])
    changes = np.flatnonzero(np.abs(np.diff(even_a)) > STEADY_A) + 1
    since = np.arange(len(even_a)) - np.repeat([0, *changes], np.diff([0, *changes, len(even_a)]))
    kept_a = even_a[since * STEP_S <= LONGEST_STEADY_S]
    return np.arange(len(kept_a)) * STEP_S, kept_a


def low_pass(current: np.ndarray, tau_s: float) -> np.ndarray:
    """First order, exact for straight lines between rows, at rest before the first one; 0 s: the current itself."""
    if tau_s == 0.0:
        return current
    kept = np.exp(-STEP_S / tau_s)
    slope = 1.0 - (1.0 - kept) * tau_s / STEP_S
    passed = lfilter([slope, 1.0 - kept - slope], [1.0, -kept], current)
    # The filter takes the first row for a rise out of nothing.
    return passed - passed[0] * kept ** np.arange(len(current))


def diffusion_ladder(ohm: float, tau_s: float, terms: int = 12) -> Ladder:
    """Z = R·tanh(√(sτ))/√(sτ) as RC branches: poles at ((k − ½)·π)²/τ; what they leave acts at once."""
    poles = ((np.arange(terms) + 0.5) * np.pi) ** 2
    return (*((2.0 * ohm / pole, tau_s / pole) for pole in poles), (ohm * (1.0 - float(np.sum(2.0 / poles))), 0.0))


@dataclasses.dataclass(frozen=True)
class Design:
    """A cell as designed, and what the model file says of it.

    Attributes
    ----------
    ocv : pairs of state of charge (0 … 1) and open-circuit voltage in V.
    resistance_ohm : ohmic, at 25 °C; `resistance_uncertainty` is relative.
    arrhenius_k : Arrhenius temperature of every resistance in K.
    polarisation, diffusion : relaxation that the design knows, if it does; Ω and s.
    """

    name: str
    capacity_ah: float
    ocv: np.ndarray
    resistance_ohm: float
    initial_soc: float
    resistance_uncertainty: float = 0.0
    initial_soc_uncertainty: float = 0.0
    arrhenius_k: float = 0.0
    polarisation: Ladder = ()
    diffusion: tuple[float, float] | None = None

    def soc(self, current_a: np.ndarray) -> np.ndarray:
        """State of charge at the rows, 0 … 1."""
        charge_c = np.concatenate([[0.0], np.cumsum(0.5 * (current_a[1:] + current_a[:-1]) * STEP_S)])
        return self.initial_soc - charge_c / (3600.0 * self.capacity_ah)

    def open_circuit_v(self, soc: np.ndarray) -> np.ndarray:
        """Straight lines in the table and beyond its ends, in V."""
        soc_table, volts = self.ocv.T
        below = np.minimum(soc - soc_table[0], 0.0) * (volts[1] - volts[0]) / (soc_table[1] - soc_table[0])
        above = np.maximum(soc - soc_table[-1], 0.0) * (volts[-1] - volts[-2]) / (soc_table[-1] - soc_table[-2])
        return np.interp(soc, soc_table, volts) + below + above

    def resistance_factor(self, temp_c: np.ndarray | float) -> np.ndarray | float:
        """Arrhenius factor of every resistance, 1 at 25 °C."""
        return np.exp(self.arrhenius_k * (1.0 / (temp_c + ZERO_CELSIUS_K) - 1.0 / (REFERENCE_C + ZERO_CELSIUS_K)))

    def voltage(self, current_a: np.ndarray, temp_c: np.ndarray | float = REFERENCE_C) -> np.ndarray:
        """Cell voltage as designed, in V."""
        driven = current_a * self.resistance_factor(temp_c)
        branches = self.polarisation + (diffusion_ladder(*self.diffusion) if self.diffusion else ())
        drop = self.resistance_ohm * driven + sum(ohm * low_pass(driven, tau_s) for ohm, tau_s in branches)
        return self.open_circuit_v(self.soc(current_a)) - drop

    def lines(self, noise: str) -> list[str]:
        """The model file, without a sensor; `noise` is the case's kind."""
        part_v = SIGMA_V / np.sqrt(1.0 + WHITE_BESIDE**2)
        stated = [f"noise_v = {SIGMA_V:.6g}"]
        if noise == "coloured":
            stated = [
                f"noise_v = {WHITE_BESIDE * part_v:.6g}", f"noise_coloured_v = {part_v:.6g}",
                f"noise_coloured_tau_s = {COLOURED_TAU_S:g}",
            ]
        table = ", ".join(f"[{soc:.6g}, {volts:.7g}]" for soc, volts in self.ocv)
        lines = [
            "schema = 1", f'name = "{self.name}"', "", "[battery]", f"capacity_ah = {self.capacity_ah:.8g}",
            f"ohmic_resistance_ohm = {self.resistance_ohm:.8g}", f"resistance_uncertainty = {self.resistance_uncertainty:g}",
            f"initial_soc = {self.initial_soc:.8g}",
            f"initial_soc_uncertainty = {self.initial_soc_uncertainty:g}", *stated, f"ocv = [{table}]",
        ]
        if self.arrhenius_k:
            lines += ["", "[effects.resistance-temperature]", f"b_k = {self.arrhenius_k:.6g}"]
        if self.polarisation:
            lines += ["", "[effects.polarisation]"]
            for index, (ohm, tau_s) in enumerate(self.polarisation, 1):
                lines += [f"r{index}_ohm = {ohm:.8g}", f"tau{index}_s = {tau_s:.8g}"]
        if self.diffusion:
            lines += ["", "[effects.diffusion]", f"r_ohm = {self.diffusion[0]:.8g}", f"tau_s = {self.diffusion[1]:.8g}"]
        return lines


def with_noise(case: dict, purpose: str, quiet_v: np.ndarray) -> np.ndarray:
    """The voltage in V as it is recorded; the noise follows from the case's seed and id."""
    random, rows, kind = stream(case, purpose), len(quiet_v), case["noise"]
    if kind == "white":
        return quiet_v + SIGMA_V * random.standard_normal(rows)
    if kind == "coloured":
        part_v = SIGMA_V / np.sqrt(1.0 + WHITE_BESIDE**2)
        white_v = WHITE_BESIDE * part_v * random.standard_normal(rows)
        return quiet_v + white_v + coloured(random, rows, COLOURED_TAU_S / STEP_S, part_v)
    if kind == "quantised":
        step_v = SIGMA_V / np.sqrt(WHITE_BESIDE**2 + 1.0 / 12.0)
        return np.round((quiet_v + WHITE_BESIDE * step_v * random.standard_normal(rows)) / step_v) * step_v
    return quiet_v


@dataclasses.dataclass(frozen=True)
class Made:
    """One drive of the cell.

    Attributes
    ----------
    columns : what is recorded beside the voltage, by canonical names, `i_ref_a` among them.
    quiet_v : voltage in V without noise, with everything that is concealed.
    designed_v : voltage in V as the model file has it from the recorded columns.
    """

    columns: dict[str, np.ndarray]
    quiet_v: np.ndarray
    designed_v: np.ndarray


def write_case(out: pathlib.Path, case: dict, fitted: Made, holdout: Made, model: list[str], truth: dict) -> None:
    """Recording, held-out recording, model file and truth; numbers in files are rounded to what is stated here."""
    oracle, before = {}, {}
    for name, made in {"recording": fitted, "holdout": holdout}.items():
        noisy_v = with_noise(case, name, made.quiet_v)
        columns = {"t_s": np.arange(len(noisy_v)) * STEP_S, **made.columns, "v_cell_v": noisy_v}
        table = np.column_stack(list(columns.values()))
        np.savetxt(out / f"{name}.csv", table, delimiter=",", header=",".join(columns), comments="", fmt="%.8g")
        oracle[name] = rms(noisy_v - made.quiet_v)
        before[name] = rms(noisy_v - made.designed_v)
    (out / "model.toml").write_text("\n".join(model) + "\n", encoding="utf-8")
    noise_rms = SIGMA_V if case["noise"] != "none" else 0.0
    truth = truth | {"noise_rms": noise_rms, "oracle_rms": oracle, "before_rms": before}
    (out / "truth.json").write_text(json.dumps(truth, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def visible_v(strength: float) -> float:
    """Change of the voltage in V, rms, of a strength."""
    return strength * JUST_VISIBLE * SIGMA_V


def scaled(change_v, first: float, wanted_v: float, what: str, tolerance: float = 0.01) -> float:
    """The size at which `change_v(size)` is wanted_v, by secants of its logarithm; nearly a power law."""
    sizes, changes, slope = [first], [change_v(first)], 1.0
    while len(sizes) < TRIES and changes[-1] > 0.0 and abs(changes[-1] / wanted_v - 1.0) > tolerance:
        if len(sizes) > 1:
            slope = np.clip(np.log(changes[-1] / changes[-2]) / np.log(sizes[-1] / sizes[-2]), 0.2, 3.0)
        sizes.append(float(sizes[-1] * (wanted_v / changes[-1]) ** (1.0 / slope)))
        changes.append(change_v(sizes[-1]))
    if abs(changes[-1] / wanted_v - 1.0) <= tolerance:
        return sizes[-1]
    raise RuntimeError(f"{what}: {1e3 * wanted_v:.3g} mV is out of its reach, last {1e3 * changes[-1]:.3g} mV at {sizes[-1]:.3g}")
