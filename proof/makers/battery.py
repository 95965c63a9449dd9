"""Cells of our own equations, solved by scipy's LSODA (kind c): each effect of a battery, alone or with others, concealed.

The cell is open-circuit voltage and ohmic resistance, both of the Panasonic cell (recordings/panasonic-18650pf), and what is
concealed; every effect that remembers is a differential equation of its own. The equations follow the table of effects and are
written anew here. Each drive begins after a long rest: everything at rest, no hysteresis.

Options of a case: `temperature` "swing" (default) or "constant"; `relaxation` true: the cell has relaxation that the design
knows; `uncertain` true: initial state of charge and resistance are off, by what the model file states; `masked` true: the sign
of an effect that can have either is the one that hides the others.
"""

import dataclasses
import functools
import pathlib

import numpy as np
import scipy
from scipy.integrate import odeint

from case import rms
from cell_case import (
    OTHER_DRIVE, REFERENCE_C, STEP_S, Design, Made, drive_a, scaled, visible_v, write_case,
)
from drives import RECORDINGS, coloured, stream

CAPACITY_AH = 2.9973
"""Discharged at C/20 and 25 °C; rated 2.9 Ah."""
RESISTANCE_OHM = 0.0225
"""Median of the voltage steps of the pulse test at 25 °C."""
INITIAL_SOC, LOW_INITIAL_SOC = 0.9, 0.63
"""The low one has US06 end at 8 %, for what shows when the cell is nearly empty."""
KNOWN_B_K = 2500.0
"""Arrhenius temperature of the resistance that the design knows where the cell's own warming is concealed."""
CHAMBER_C = 10.0
KNOWN_POLARISATION = ((0.008, 6.0), (0.010, 45.0))
KNOWN_DIFFUSION = (0.015, 500.0)
RELATIVE_TOLERANCE = 1e-6
CHARGE_TOLERANCE = 1e-9
"""A charge forgets none of its errors: with 1e-6 a drive leaves 40 ppm, 0.03 mV."""
CELLS_ACROSS, GROWTH = 30, 1.18
"""Finite volumes of the diffusion, each thicker than the one before it."""
REMEMBERED = 32
TEMPERATURE_NOISE_K = 0.05
LEAST_EFFICIENCY = 0.9
"""A cell that is in use gives back more of its charge: lithium-ion 0.99 and more, lead–acid and nickel–metal hydride, not charged to
the brim, 0.9 and more (Linden's Handbook of Batteries). A drive that hardly charges asks for less, below 0 at the end."""
SOC_UNCERTAINTY, RESISTANCE_UNCERTAINTY = 0.005, 0.03

Values = dict[str, float]
"""Parameters of an effect by their names, which carry the unit."""


def piecewise(series: np.ndarray):
    """A function of time in s: straight lines between rows."""
    values, rises = series.tolist(), np.diff(series, append=series[-1]).tolist()
    last = len(values) - 1

    def at(t_s: float) -> float:
        row = min(int(t_s / STEP_S), last)
        return values[row] + rises[row] * (t_s / STEP_S - row)

    return at


def solved(slope, start: list[float], rows: int, rtol: float = RELATIVE_TOLERANCE, **bands: int) -> np.ndarray:
    """States on the rows, one row of the table to a state; no step is longer than the time between rows.

    `odeint` walks from row to row within ODEPACK; `solve_ivp` would come back to Python after each of LSODA's steps.
    """
    states, told = odeint(
        slope, start, np.arange(rows) * STEP_S, tfirst=True, rtol=rtol, atol=1e-9, hmax=STEP_S, full_output=True, **bands)
    if told["message"] != "Integration successful.":
        raise RuntimeError(f"odeint: {told['message']}")
    return states.T


def remembered(solve):
    """The same solution is not calculated twice: sizes of an effect are tried on one drive."""
    known: dict[tuple, np.ndarray] = {}

    @functools.wraps(solve)
    def remembering(current_a: np.ndarray, *values: float) -> np.ndarray:
        key = (current_a.tobytes(), *values)
        if key not in known:
            if len(known) >= REMEMBERED:
                known.pop(next(iter(known)))
            known[key] = solve(current_a, *values)
        return known[key]

    return remembering


@remembered
def state_of_charge(current_a: np.ndarray, start: float, capacity_ah: float, efficiency: float) -> np.ndarray:
    """dSoC/dt = −i/Q; of what is charged only the efficiency counts."""
    current = piecewise(current_a)
    per_as = 1.0 / (3600.0 * capacity_ah)

    def slope(t_s: float, _) -> list[float]:
        flow = current(t_s)
        return [-per_as * (flow if flow > 0.0 else efficiency * flow)]

    return solved(slope, [start], len(current_a), CHARGE_TOLERANCE)[0]


@remembered
def relaxed(driven_a: np.ndarray, tau_s: float) -> np.ndarray:
    """Current in A through the resistance of an RC branch: τ·dx/dt + x = i."""
    current = piecewise(driven_a)
    return solved(lambda t_s, x: [(current(t_s) - x[0]) / tau_s], [0.0], len(driven_a))[0]


@functools.cache
def volumes() -> tuple[np.ndarray, np.ndarray]:
    """Thicknesses of the finite volumes and distances between their middles (the last: to the far side), of a thickness of 1."""
    thick = GROWTH ** np.arange(CELLS_ACROSS)
    thick /= thick.sum()
    return thick, np.append(0.5 * (thick[1:] + thick[:-1]), 0.5 * thick[-1])


@remembered
def diffused(driven_a: np.ndarray, tau_s: float) -> np.ndarray:
    """τ·∂c/∂t = ∂²c/∂x², −∂c/∂x = i at x = 0, c = 0 at x = 1; c(0) in A. Its impedance is tanh(√(sτ))/√(sτ)."""
    current = piecewise(driven_a)
    thick, apart = volumes()
    # Of each volume: what comes over its near side less what goes over its far side.
    flows = np.diag(1.0 / apart) - np.diag(1.0 / apart[:-1], 1)
    changes = (np.vstack([np.zeros(CELLS_ACROSS), flows[:-1]]) - flows) / (thick * tau_s)[:, None]
    enters = 1.0 / (thick[0] * tau_s)

    def slope(t_s: float, c: np.ndarray) -> np.ndarray:
        change = changes @ c
        change[0] += enters * current(t_s)
        return change

    c = solved(slope, [0.0] * CELLS_ACROSS, len(driven_a), ml=1, mu=1)
    return c[0] + 0.5 * thick[0] * driven_a


@remembered
def hysteresis(current_a: np.ndarray, capacity_ah: float, gamma: float) -> np.ndarray:
    """dh/dt = −γ·abs(i)/(3600·Q)·(h + sgn i)."""
    current = piecewise(current_a)
    rate = gamma / (3600.0 * capacity_ah)

    def slope(t_s: float, h: np.ndarray) -> list[float]:
        i = current(t_s)
        return [-rate * (abs(i) * h[0] + i)]

    return solved(slope, [0.0], len(current_a))[0]


def warmed(current_a: np.ndarray, around_c: np.ndarray, design: Design, rth_k_per_w: float, tau_s: float) -> np.ndarray:
    """Temperature of the cell in °C: τ·dΔT/dt + ΔT = rth·R(T)·i²."""
    current, around = piecewise(current_a), piecewise(around_c)

    def slope(t_s: float, warmer: np.ndarray) -> list[float]:
        loss_w = design.resistance_ohm * design.resistance_factor(around(t_s) + warmer[0]) * current(t_s) ** 2
        return [(rth_k_per_w * loss_w - warmer[0]) / tau_s]

    return around_c + solved(slope, [0.0], len(current_a))[0]


@dataclasses.dataclass(frozen=True)
class Drive:
    """Currents in A that flow, and temperature in °C of the cell or, where that is concealed, of the chamber."""

    current_a: np.ndarray
    temp_c: np.ndarray


def voltage(drive: Drive, cell: Design, hidden: dict[str, Values]) -> np.ndarray:
    """Voltage in V of a cell with what is concealed."""
    rows = len(drive.current_a)

    def value(effect: str, name: str, off: float) -> float:
        return hidden.get(effect, {}).get(name, off)

    # A consumer's current goes through the cell like any other.
    i = drive.current_a + value("parasitic-load", "load_a", 0.0)
    capacity_ah = value("capacity", "capacity_ah", cell.capacity_ah)
    soc = state_of_charge(i, cell.initial_soc, capacity_ah, value("coulombic-efficiency", "efficiency", 1.0))
    temp_c = drive.temp_c
    if "cell-self-heating" in hidden:
        temp_c = warmed(i, temp_c, cell, **hidden["cell-self-heating"])
    if "resistance-temperature" in hidden:
        cell = dataclasses.replace(cell, arrhenius_k=hidden["resistance-temperature"]["b_k"])
    if "resistance" in hidden:
        cell = dataclasses.replace(cell, resistance_ohm=cell.resistance_ohm * hidden["resistance"]["scale"])
    factor = cell.resistance_factor(temp_c)
    if "resistance-soc" in hidden:
        law = hidden["resistance-soc"]
        factor = factor * (1.0 + law["rise"] * np.maximum(1.0 - soc / law["knee_soc"], 0.0))
    volts = cell.open_circuit_v(soc) - cell.resistance_ohm * factor * i
    branches, diffusion = list(cell.polarisation), [cell.diffusion] if cell.diffusion else []
    if "polarisation" in hidden:
        law = hidden["polarisation"]
        branches += [(law[f"r{k}_ohm"], law[f"tau{k}_s"]) for k in (1, 2, 3) if f"r{k}_ohm" in law]
    if "diffusion" in hidden:
        diffusion.append((hidden["diffusion"]["r_ohm"], hidden["diffusion"]["tau_s"]))
    volts -= sum((ohm * relaxed(factor * i, tau_s) for ohm, tau_s in branches), np.zeros(rows))
    volts -= sum((ohm * diffused(factor * i, tau_s) for ohm, tau_s in diffusion), np.zeros(rows))
    if "ocv-hysteresis" in hidden:
        law = hidden["ocv-hysteresis"]
        volts += law["m_v"] * hysteresis(i, capacity_ah, law["gamma"])
    volts += value("entropic", "v_per_k", 0.0) * (temp_c - REFERENCE_C)
    return outside(volts, i, soc, hidden)


# What the library does not hold.


def outside(volts: np.ndarray, current_a: np.ndarray, soc: np.ndarray, hidden: dict[str, Values]) -> np.ndarray:
    """The voltage in V with physics that the library lacks."""
    if "voltage-gain" in hidden:
        # The instrument's sensitivity; its zero is right at 3.7 V.
        volts = volts + hidden["voltage-gain"]["error"] * (volts - 3.7)
    if "contact-resistance-rise" in hidden:
        hours = np.arange(len(volts)) * STEP_S / 3600.0
        volts = volts - hidden["contact-resistance-rise"]["ohm_per_h"] * hours * current_a
    if "loose-contact" in hidden:
        law = hidden["loose-contact"]
        open_now = np.mod(np.arange(len(volts)) * STEP_S - law["from_s"], law["every_s"]) < law["for_s"]
        volts = volts - law["ohm"] * open_now * current_a
    if "ocv-step" in hidden:
        law = hidden["ocv-step"]
        volts = volts + 0.5 * law["step_v"] * np.tanh((soc - law["soc"]) / law["width_soc"])
    if "charge-resistance" in hidden:
        volts = volts - hidden["charge-resistance"]["ohm"] * np.minimum(current_a, 0.0)
    return volts


OUTSIDE = ("voltage-gain", "contact-resistance-rise", "loose-contact", "ocv-step", "charge-resistance")


def between(random: np.random.Generator, low: float, high: float) -> float:
    """A number drawn evenly in its logarithm."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def sign(random: np.random.Generator) -> float:
    """−1 or 1."""
    return float(random.choice([-1.0, 1.0]))


# Parameters of each effect, from one number above 0 that makes it larger, what is free, and a sign.
PARAMETERS = {
    "capacity": lambda size, draw, sign: {"capacity_ah": CAPACITY_AH * (1.0 + sign * size)},
    "coulombic-efficiency": lambda size, draw, sign: {"efficiency": 1.0 - size},
    "parasitic-load": lambda size, draw, sign: {"load_a": size},
    "offset": lambda size, draw, sign: {"offset_a": sign * size},
    "polarisation": lambda size, draw, sign: {"r1_ohm": size, "tau1_s": draw["tau1_s"]},
    "diffusion": lambda size, draw, sign: {"r_ohm": size, "tau_s": draw["tau_s"]},
    "ocv-hysteresis": lambda size, draw, sign: {"m_v": size, "gamma": draw["gamma"]},
    "resistance": lambda size, draw, sign: {"scale": float(np.exp(sign * size))},
    "resistance-temperature": lambda size, draw, sign: {"b_k": 1000.0 * size},
    "resistance-soc": lambda size, draw, sign: {"rise": size, "knee_soc": 0.45},
    "cell-self-heating": lambda size, draw, sign: {"rth_k_per_w": size, "tau_s": draw["heat_tau_s"]},
    "entropic": lambda size, draw, sign: {"v_per_k": sign * size},
    "voltage-gain": lambda size, draw, sign: {"error": sign * size},
    "contact-resistance-rise": lambda size, draw, sign: {"ohm_per_h": size},
    "loose-contact": lambda size, draw, sign: {"ohm": size, "from_s": draw["loose_s"], "every_s": 1000.0, "for_s": 170.0},
    "ocv-step": lambda size, draw, sign: {"step_v": sign * size, "soc": draw["step_soc"], "width_soc": 0.004},
    "charge-resistance": lambda size, draw, sign: {"ohm": sign * size},
}
SIGNED = ("capacity", "offset", "resistance", "entropic", "voltage-gain", "ocv-step", "charge-resistance")
FIRST_SIZE = {
    "capacity": 0.01, "coulombic-efficiency": 0.01, "parasitic-load": 0.02, "offset": 0.02, "polarisation": 1e-3, "diffusion": 2e-3,
    "ocv-hysteresis": 2e-3, "resistance": 0.05, "resistance-temperature": 0.3, "resistance-soc": 0.1,
    "cell-self-heating": 1.0, "entropic": 1e-4,
    "voltage-gain": 0.01, "contact-resistance-rise": 1e-3, "loose-contact": 1e-3,
    "ocv-step": 1e-3, "charge-resistance": 1e-3,
}


def design_of(case: dict) -> Design:
    """The cell as the model file has it."""
    ids, options = {effect["id"] for effect in case["effects"]}, case["options"]
    known = {"temperature", "relaxation", "uncertain", "masked"}
    if unknown := set(options) - known:
        raise ValueError(f"options: expected {', '.join(sorted(known))}, found {', '.join(sorted(unknown))}")
    for effect in ids - set(PARAMETERS):
        raise ValueError(f"effects: expected one of {', '.join(PARAMETERS)}, found {effect!r}")
    table = np.genfromtxt(RECORDINGS / "panasonic-18650pf/ocv_25c.csv", delimiter=",", names=True)
    relaxation = bool(options.get("relaxation"))
    if relaxation and ids & {"polarisation", "diffusion"}:
        raise ValueError("options.relaxation: the design knows what is to be concealed")
    uncertain = bool(options.get("uncertain"))
    return Design(
        name="Panasonic 18650PF", capacity_ah=CAPACITY_AH, ocv=np.column_stack([table["soc"], table["ocv_v"]]),
        resistance_ohm=RESISTANCE_OHM, initial_soc=LOW_INITIAL_SOC if "resistance-soc" in ids else INITIAL_SOC,
        resistance_uncertainty=RESISTANCE_UNCERTAINTY if uncertain else 0.0,
        initial_soc_uncertainty=SOC_UNCERTAINTY if uncertain else 0.0,
        arrhenius_k=KNOWN_B_K if "cell-self-heating" in ids else 0.0,
        polarisation=KNOWN_POLARISATION if relaxation else (), diffusion=KNOWN_DIFFUSION if relaxation else None,
    )


def drive_of(case: dict, name: str) -> Drive:
    """A drive of the case, with the temperature of its own day."""
    rows, random = case["rows"], stream(case, f"temperature {name}")
    current_a = drive_a(name, rows)
    temp_c = np.full(rows, CHAMBER_C if any(effect["id"] == "cell-self-heating" for effect in case["effects"]) else REFERENCE_C)
    temperature = case["options"].get("temperature", "swing")
    if temperature not in ("swing", "constant"):
        raise ValueError(f"options.temperature: expected swing or constant, found {temperature!r}")
    if temperature == "swing":
        t_s = np.arange(rows) * STEP_S
        temp_c += 10.0 * np.sin(t_s / 400.0 + random.uniform(0.0, 2.0 * np.pi)) + coloured(random, rows, 300.0 / STEP_S, 2.0)
    return Drive(current_a, temp_c)


class Conceal:
    """Finds parameters for the effects of a case, each as if it were alone."""

    def __init__(self, case: dict, cell: Design, drive: Drive) -> None:
        self.random, self.cell, self.drive = stream(case, "effects"), cell, drive
        soc = cell.soc(drive.current_a)
        self.draw = {
            "tau1_s": between(self.random, 5.0, 60.0), "tau_s": between(self.random, 150.0, 800.0),
            "gamma": between(self.random, 30.0, 200.0), "heat_tau_s": between(self.random, 200.0, 900.0),
            "loose_s": float(self.random.uniform(200.0, 800.0)),
            "step_soc": float(soc[0] + self.random.uniform(0.3, 0.7) * (soc[-1] - soc[0])),
        }
        self.plain = voltage(drive, cell, {})

    def change(self, effect: str, values: Values) -> np.ndarray:
        """What an effect does to the voltage in V, against what is recorded; an offset is of the instrument."""
        if effect == "offset":
            return self.plain - self.cell.voltage(self.drive.current_a + values["offset_a"], self.drive.temp_c)
        return voltage(self.drive, self.cell, {effect: values}) - self.plain

    def parameters(self, effect: str, strength: float, before: np.ndarray | None) -> tuple[Values, np.ndarray]:
        """Parameters of a strength, and the change in V. `before`: what the sign is to hide, in V."""

        def values(size: float, sign: float) -> Values:
            return PARAMETERS[effect](size, self.draw, sign)

        drawn = sign(self.random)
        size = scaled(lambda size: rms(self.change(effect, values(size, drawn))), FIRST_SIZE[effect], visible_v(strength), effect)
        choices = [drawn] if before is None or effect not in SIGNED else [-1.0, 1.0]
        if effect == "coulombic-efficiency" and values(size, drawn)["efficiency"] < LEAST_EFFICIENCY:
            raise RuntimeError(f"{effect}: {1e3 * visible_v(strength):.3g} mV is out of its reach, no cell loses {size:.2g} of its charge")
        changes = [self.change(effect, values(size, choice)) for choice in choices]
        best = int(np.argmin([rms(change if before is None else before + change) for change in changes]))
        return values(size, choices[best]), changes[best]


def make(case: dict, out: pathlib.Path) -> None:
    """Writes a case."""
    stated = design_of(case)
    cell = stated
    if case["options"].get("uncertain"):
        random = stream(case, "uncertain")
        cell = dataclasses.replace(
            stated, initial_soc=stated.initial_soc + SOC_UNCERTAINTY * random.standard_normal(),
            resistance_ohm=stated.resistance_ohm * (1.0 + RESISTANCE_UNCERTAINTY * random.standard_normal()))
    drives = [drive_of(case, name) for name in (case["drive"], OTHER_DRIVE.get(case["drive"], ""))]
    hidden: dict[str, Values] = {}
    if case["effects"]:
        find, before = Conceal(case, cell, drives[0]), None
        # What can have either sign comes last, to hide the others.
        masked = bool(case["options"].get("masked"))
        for effect in sorted(case["effects"], key=lambda effect: masked and effect["id"] in SIGNED):
            hidden[effect["id"]], change = find.parameters(effect["id"], effect["strength"], before)
            if masked:
                before = change if before is None else before + change
    made = [recorded(case, drive, cell, stated, hidden, index) for index, drive in enumerate(drives)]
    without = recorded(case, drives[0], cell, stated, {}, 0)
    # Against what is recorded: an offset is in the current.
    together_v = made[0].quiet_v - without.quiet_v - (made[0].designed_v - without.designed_v)
    # Of one alone it is the strength that was asked for, to within the search for it.
    combined = {"combined_strength": rms(together_v) / visible_v(1.0)} if len(hidden) > 1 else {}
    write_case(out, case, *made, stated.lines(case["noise"]), truth(hidden) | combined)


def recorded(case: dict, drive: Drive, cell: Design, stated: Design, hidden: dict[str, Values], index: int) -> Made:
    """A drive as it is recorded."""
    random = stream(case, f"instruments {index}")
    seen_a = drive.current_a + hidden.get("offset", {}).get("offset_a", 0.0)
    known_c = drive.temp_c + TEMPERATURE_NOISE_K * random.standard_normal(len(seen_a))
    column = "temp_ambient_c" if "cell-self-heating" in hidden else "temp_cell_c"
    quiet_v = voltage(drive, cell, hidden)
    return Made({"i_ref_a": seen_a, column: known_c}, quiet_v, stated.voltage(seen_a, known_c))


def truth(hidden: dict[str, Values]) -> dict:
    """What is concealed."""
    classes, why, allowed = [], None, []
    if "offset" in hidden:
        classes.append(["offset", "parasitic-load"])
        why = "The current has one instrument: a zero error and a consumer that it does not see are the same."
    if "contact-resistance-rise" in hidden:
        allowed.append("resistance-soc")
        why = "In a drive without a charge time and state of charge go together: rising with the one is falling with the other."
    if {"contact-resistance-rise", "loose-contact"} & set(hidden):
        # Within the ohmic resistance as it is measured, and over the drive it has a mean.
        allowed.append("resistance")
    names = {effect: ["parasitic-load", "offset"] if effect == "offset" else [effect] for effect in hidden}
    return {
        "kind": "c", "maker": f"own equations, scipy {scipy.__version__} odeint (LSODA)",
        "effects": [{"id": effect, "parameters": values} for effect, values in hidden.items()],
        "required": [names[effect] for effect in hidden if effect not in OUTSIDE],
        "allowed": allowed, "class_ids": classes, "why": why, "where": where(hidden),
    }


def where(hidden: dict[str, Values]) -> dict | None:
    """Where the only effect acts, if that is a region of a recorded column."""
    if list(hidden) == ["charge-resistance"]:
        return {"column": "i_ref_a", "from": None, "to": 0.0, "absolute": False}
    return None
