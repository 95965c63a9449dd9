"""Cells simulated by PyBaMM, a simulator that others wrote (kind b): single-particle (SPMe) and Doyle–Fuller–Newman (DFN).

The cell is PyBaMM's in every respect. What is concealed is a part of its physics, or a flaw of the way in which its current is
recorded. The model file is what a user has of such a cell: its open-circuit voltage, its instantaneous resistance, its capacity.

Diffusion in particles and electrolyte is part of every cell here and cannot be switched off. It is concealed itself with the
design "ocv-resistance". For any other effect the design is "relaxation": an equivalent circuit fitted (scipy) to another stretch
of driving of the same cell without the effect. The circuit is no DFN: what of relaxation is left beside it is true of the data.

`diffusion` (or `polarisation`), and `resistance-temperature` with a `temperature_c` that is not 25 °C, have the size that the
cell gives them, whatever strength is asked for.

Options of a case: `model` "spme" or "dfn"; `parameters` a PyBaMM set of LG M50; `temperature_c` of the surroundings;
`thermal` "isothermal" (the cell has the temperature of the surroundings) or "lumped"; `design`; `scale` of the current.
"""

import dataclasses
import functools
import os
import pathlib

# PyBaMM asks on its first import whether it may report what it is used for, and a campaign has nobody to answer.
os.environ.setdefault("PYBAMM_DISABLE_TELEMETRY", "true")

import numpy as np
import pybamm
from scipy.optimize import least_squares, nnls

from case import rms
from cell_case import (
    OTHER_DRIVE, REFERENCE_C, STEP_S, ZERO_CELSIUS_K, Design, Made, diffusion_ladder, drive_a, low_pass, scaled,
    visible_v, write_case,
)
from drives import stream

INITIAL_SOC = 0.85
DESIGN_START_S, DESIGN_ROWS = 3000.0, 3600
"""The equivalent circuit is fitted to US06 from here on: driving that 6000 rows of a case do not reach."""
SWING_PERIOD_S = 2000.0
TEMPERATURE_NOISE_K = 0.05
HYSTERESIS_DECAY = 100.0
"""Of the one-state model: the state turns by 1 − 1/e within a fiftieth of the electrode's lithium."""
SIZE_TOLERANCE = 0.05
"""A strength is met to this: each try is a solution by PyBaMM."""
TOLERANCE = 1e-5
"""Of the solver: against a tenth of it the voltage moves by 0.05 mV rms."""
LONGEST_STEP_S = 2.0
"""Of the solver: after a rest its own step would be longer than a pulse, and it would go past it without seeing it."""
RESISTANCE_UNCERTAINTY = 0.05
MODELS = {"spme": pybamm.lithium_ion.SPMe, "dfn": pybamm.lithium_ion.DFN}
RELAXATION = ["diffusion", "polarisation", "resistance-soc", "charge-transfer"]
"""True of every cell here: diffusion, and a charge transfer (Butler–Volmer) that depends on the state of charge."""
SCALE = {"ocv-resistance": 0.6, "relaxation": 0.3}
"""Of the Panasonic cell's current (2.9 Ah) for 5 Ah: 0.47C rms, at most 2.5C. A circuit is linear and reaction rates are not
(asinh): a fitted circuit leaves 14 mV rms of US06 at twice this current, 7 mV at this one, 2.5 mV at half of it."""
COLD_SCALE = 0.6
"""At 5C and 0 °C a cell of this kind is empty at the particles' surface."""
WARMING_SCALE = 0.6
"""Below, the cell does not warm enough to be seen."""
NATURAL = ("diffusion", "polarisation")
"""Relaxation."""
PHYSICAL = ("resistance-temperature", "cell-self-heating", "entropic", "ocv-hysteresis")
RECORDED = ("capacity", "coulombic-efficiency", "parasitic-load", "offset")


@dataclasses.dataclass(frozen=True)
class Cell:
    """What PyBaMM is asked for.

    Attributes
    ----------
    temperature_c, swing_k : surroundings in °C, and by how much they go down and come back, in K.
    transfer_w_m2_k : heat transfer coefficient of a lumped cell.
    hysteresis_v : the negative electrode's open-circuit potential lies between that ± this, one-state model (Axen 2022).
    entropic_v_per_k : entropic change of the positive electrode.
    frozen : reaction rates do not follow temperature.
    """

    model: str
    parameters: str
    scale: float
    temperature_c: float = REFERENCE_C
    swing_k: float = 0.0
    thermal: str = "isothermal"
    transfer_w_m2_k: float = 10.0
    hysteresis_v: float = 0.0
    entropic_v_per_k: float = 0.0
    frozen: bool = False

    def surroundings_c(self, t_s):
        """Temperature of the surroundings in °C at a time."""
        return self.temperature_c - 0.5 * self.swing_k * (1.0 - np.cos(2.0 * np.pi / SWING_PERIOD_S * t_s))


def parameter_values(cell: Cell, soc: float) -> pybamm.ParameterValues:
    """The parameter set with the cell's surroundings, at rest at a state of charge; its voltage limits do not end a drive."""
    values = pybamm.ParameterValues(cell.parameters)
    values.set_initial_state(soc)
    values.update({
        "Lower voltage cut-off [V]": 1.5, "Upper voltage cut-off [V]": 5.0,
        "Ambient temperature [K]": lambda y, z, t: ZERO_CELSIUS_K + cell.temperature_c
        - 0.5 * cell.swing_k * (1.0 - pybamm.cos(2.0 * np.pi / SWING_PERIOD_S * t)),
        "Initial temperature [K]": ZERO_CELSIUS_K + cell.temperature_c,
        "Total heat transfer coefficient [W.m-2.K-1]": cell.transfer_w_m2_k,
        "Negative electrode OCP entropic change [V.K-1]": 0.0,
        "Positive electrode OCP entropic change [V.K-1]": cell.entropic_v_per_k,
    })
    if cell.frozen:
        for side in ("Negative", "Positive"):
            name = f"{side} electrode exchange-current density [A.m-2]"
            values[name] = at_25_c(values[name])
    if cell.hysteresis_v:
        potential = values["Negative electrode OCP [V]"]
        # Towards the end of a discharge the graphite gives lithium away, its potential is the higher one.
        values.update({
            "Negative electrode delithiation OCP [V]": lambda sto: potential(sto) + cell.hysteresis_v,
            "Negative electrode lithiation OCP [V]": lambda sto: potential(sto) - cell.hysteresis_v,
            "Negative particle lithiation hysteresis decay rate": HYSTERESIS_DECAY,
            "Negative particle delithiation hysteresis decay rate": HYSTERESIS_DECAY,
            "Initial hysteresis state in negative electrode": 0.0,
        }, check_already_exists=False)
    return values


def at_25_c(rate):
    """A reaction rate that does not follow temperature."""
    return lambda c_e, c_s_surf, c_s_max, _: rate(c_e, c_s_surf, c_s_max, REFERENCE_C + ZERO_CELSIUS_K)


@functools.lru_cache(maxsize=64)
def solved(cell: Cell, drive: str, rows: int, start_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Voltage in V and temperature of the cell in °C on the drive's rows."""
    t_s = np.arange(rows) * STEP_S
    values = parameter_values(cell, INITIAL_SOC)
    values["Current function [A]"] = pybamm.Interpolant(t_s, cell.scale * drive_a(drive, rows, start_s), pybamm.t)
    return run(cell, values, t_s)


def run(cell: Cell, values: pybamm.ParameterValues, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """PyBaMM's solution at these times: voltage in V and temperature in °C."""
    options = {"thermal": cell.thermal}
    if cell.hysteresis_v:
        options["open-circuit potential"] = ("one-state hysteresis", "single")
    wanted = ["Voltage [V]", "Volume-averaged cell temperature [K]"]
    solver = pybamm.IDAKLUSolver(rtol=TOLERANCE, atol=TOLERANCE, output_variables=wanted, options={"dt_max": LONGEST_STEP_S})
    simulation = pybamm.Simulation(MODELS[cell.model](options), parameter_values=values, solver=solver)
    try:
        solution = simulation.solve([t_s[0], t_s[-1]], t_interp=t_s)
    except pybamm.SolverError as error:
        raise RuntimeError(f"PyBaMM: {error}") from error
    voltage, temperature = (np.asarray(solution[name].data).ravel() for name in wanted)
    if len(voltage) != len(t_s):
        raise RuntimeError(f"PyBaMM ended after {len(voltage)} of {len(t_s)} rows: {solution.termination}")
    return voltage, temperature - ZERO_CELSIUS_K


@functools.lru_cache(maxsize=16)
def equilibrium(parameters: str) -> tuple[float, bytes]:
    """Capacity in Ah between the set's voltage limits, and its open-circuit voltage over state of charge (a table as bytes)."""
    values = pybamm.ParameterValues(parameters)
    limits = pybamm.lithium_ion.get_min_max_stoichiometries(values)
    empty_n, full_n, full_p, empty_p = (float(x) for x in limits)
    symbols = pybamm.LithiumIonParameters()
    soc = np.linspace(0.0, 1.0, 201)
    kelvin = pybamm.Scalar(REFERENCE_C + ZERO_CELSIUS_K)

    def potential(electrode, stoichiometry: np.ndarray) -> np.ndarray:
        return values.process_symbol(electrode.prim.U(pybamm.Vector(stoichiometry), kelvin)).evaluate().ravel()

    volts = potential(symbols.p, empty_p + soc * (full_p - empty_p)) - potential(symbols.n, empty_n + soc * (full_n - empty_n))
    capacity_ah = float(values.evaluate(symbols.n.prim.Q_init)) * (full_n - empty_n)
    return capacity_ah, np.column_stack([soc, volts]).tobytes()


@functools.lru_cache(maxsize=16)
def instantaneous_ohm(cell: Cell) -> float:
    """Voltage step over a step of current of 1 A, at 50 % and 25 °C."""
    at_25 = dataclasses.replace(cell, temperature_c=REFERENCE_C, swing_k=0.0, hysteresis_v=0.0, thermal="isothermal")
    volts = []
    for current_a in (0.0, 1.0):
        values = parameter_values(at_25, 0.5)
        values["Current function [A]"] = current_a
        volts.append(run(at_25, values, np.array([0.0, 1e-4]))[0][0])
    return volts[0] - volts[1]


def bare_design(cell: Cell) -> Design:
    """Open-circuit voltage, instantaneous resistance and capacity: what a data sheet and one pulse tell."""
    capacity_ah, table = equilibrium(cell.parameters)
    ocv = np.frombuffer(table).reshape(-1, 2)
    return Design(
        name=f"{cell.parameters} cell, {cell.model.upper()}", capacity_ah=capacity_ah, ocv=ocv,
        resistance_ohm=instantaneous_ohm(cell), initial_soc=INITIAL_SOC, resistance_uncertainty=RESISTANCE_UNCERTAINTY,
    )


@functools.lru_cache(maxsize=16)
def circuit_design(cell: Cell, thermal_law: bool) -> Design:
    """An equivalent circuit of the cell: resistance, two branches, diffusion; fitted where the campaign does not look.

    With `thermal_law` the cell is driven through a swing of temperature, and the Arrhenius temperature is fitted too.
    """
    bare = bare_design(cell)
    driven = dataclasses.replace(cell, thermal="isothermal", swing_k=15.0 if thermal_law else 0.0)
    current_a = cell.scale * drive_a("us06", DESIGN_ROWS, DESIGN_START_S)
    voltage, temp_c = solved(driven, "us06", DESIGN_ROWS, DESIGN_START_S)
    drop = bare.open_circuit_v(bare.soc(current_a)) - voltage

    def columns(guess: np.ndarray) -> np.ndarray:
        law = dataclasses.replace(bare, arrhenius_k=1000.0 * guess[3])
        through = current_a * law.resistance_factor(temp_c)
        taus_s = np.exp(guess[:3])
        diffused = sum(ohm * low_pass(through, tau_s) for ohm, tau_s in diffusion_ladder(1.0, taus_s[2]))
        return np.column_stack([through, low_pass(through, taus_s[0]), low_pass(through, taus_s[1]), diffused])

    def left(guess: np.ndarray) -> np.ndarray:
        table = columns(guess)
        return table @ nnls(table, drop)[0] - drop

    free = 6.0 if thermal_law else 1e-9
    start = np.array([np.log(5.0), np.log(40.0), np.log(400.0), 0.5 * free])
    low, high = np.log([0.5, 8.0, 80.0]), np.log([20.0, 200.0, 5000.0])
    fit = least_squares(left, start, bounds=([*low, 0.0], [*high, free]), diff_step=1e-3, max_nfev=25)
    ohms = nnls(columns(fit.x), drop)[0]
    taus_s = np.exp(fit.x[:3])
    return dataclasses.replace(
        bare, resistance_ohm=float(ohms[0]), arrhenius_k=1000.0 * float(fit.x[3]) if thermal_law else 0.0,
        polarisation=tuple((float(ohm), float(tau_s)) for ohm, tau_s in zip(ohms[1:3], taus_s)),
        diffusion=(float(ohms[3]), float(taus_s[2])),
    )


def with_physics(cell: Cell, effect: str, size: float) -> Cell:
    """The cell with an effect of its physics; what one size stands for is the effect's own."""
    if effect == "resistance-temperature":
        return dataclasses.replace(cell, swing_k=size)
    if effect == "cell-self-heating":
        return dataclasses.replace(cell, thermal="lumped", transfer_w_m2_k=1.0 / size)
    if effect == "entropic":
        return dataclasses.replace(cell, entropic_v_per_k=size)
    return dataclasses.replace(cell, hysteresis_v=size)


def cold(effect: str, cell: Cell) -> bool:
    """Whether the surroundings say how large the effect is."""
    return effect == "resistance-temperature" and cell.temperature_c != REFERENCE_C


FIRST_SIZE = {"resistance-temperature": 5.0, "cell-self-heating": 0.03, "entropic": 2e-4, "ocv-hysteresis": 0.005}


def recorded_a(effect: str, size: float, current_a: np.ndarray) -> np.ndarray:
    """What the instrument sees in A of the current that the cell's charge follows."""
    if effect == "parasitic-load":
        return current_a - size
    if effect == "offset":
        return current_a + size
    if effect == "coulombic-efficiency":
        return np.where(current_a < 0.0, current_a / (1.0 - size), current_a)
    return current_a


def design_of(case: dict) -> str:
    """What the model file knows."""
    natural = any(effect["id"] in NATURAL for effect in case["effects"])
    design = case["options"].get("design", "ocv-resistance" if natural else "relaxation")
    if design not in SCALE:
        raise ValueError(f"options.design: expected {', '.join(SCALE)}, found {design!r}")
    return design


def base_cell(case: dict) -> Cell:
    """The cell of a case before any effect."""
    options, ids = case["options"], {effect["id"] for effect in case["effects"]}
    known = {"model", "parameters", "temperature_c", "thermal", "design", "scale"}
    if unknown := set(options) - known:
        raise ValueError(f"options: expected {', '.join(sorted(known))}, found {', '.join(sorted(unknown))}")
    thermal = ids & {"resistance-temperature", "cell-self-heating"}
    temperature_c = options.get("temperature_c", 10.0 if "cell-self-heating" in ids else REFERENCE_C)
    scale = WARMING_SCALE if "cell-self-heating" in ids else SCALE[design_of(case)] * (COLD_SCALE if temperature_c < 15.0 else 1.0)
    cell = Cell(
        model=options.get("model", "spme"), parameters=options.get("parameters", "OKane2022" if thermal else "Chen2020"),
        scale=options.get("scale", scale), temperature_c=temperature_c, thermal=options.get("thermal", "isothermal"),
    )
    if cell.model not in MODELS:
        raise ValueError(f"options.model: expected {', '.join(MODELS)}, found {cell.model!r}")
    if "entropic" in ids:
        # Only the open-circuit voltage follows the temperature.
        cell = dataclasses.replace(cell, swing_k=20.0, temperature_c=35.0, frozen=True)
    return cell


class Conceal:
    """Finds sizes for the effects of a case, one after the other, each as if it were alone."""

    def __init__(self, case: dict, design: Design, cell: Cell) -> None:
        self.case, self.design, self.cell = case, design, cell
        self.drive, self.rows = case["drive"], case["rows"]
        self.current_a = cell.scale * drive_a(self.drive, self.rows)
        self.random = stream(case, "effects")

    def physical(self, effect: str, strength: float) -> float:
        """Size of an effect of the cell's physics."""
        plain = solved(self.cell, self.drive, self.rows)[0]

        def change_v(size: float) -> float:
            return rms(solved(with_physics(self.cell, effect, size), self.drive, self.rows)[0] - plain)

        return scaled(change_v, FIRST_SIZE[effect], visible_v(strength), effect, SIZE_TOLERANCE)

    def recorded(self, effect: str, strength: float) -> float:
        """Size of an effect of the recording: load or offset in A, lost share of charge, excess of the stated capacity."""
        designed = self.design.voltage(self.current_a)

        def change_v(size: float) -> float:
            if effect == "capacity":
                wrong = dataclasses.replace(self.design, capacity_ah=self.design.capacity_ah * (1.0 + size))
                return rms(wrong.voltage(self.current_a) - designed)
            return rms(self.design.voltage(recorded_a(effect, size, self.current_a)) - designed)

        sign = float(self.random.choice([-1.0, 1.0])) if effect in ("capacity", "offset") else 1.0
        return sign * scaled(lambda size: change_v(sign * size), 0.01, visible_v(strength), effect)


def parameters_of(effect: str, size: float, design: Design) -> dict[str, float | None]:
    """By the library's names, where PyBaMM has a counterpart."""
    return {
        "capacity": {"capacity_ah": design.capacity_ah},
        "coulombic-efficiency": {"efficiency": 1.0 - size},
        "parasitic-load": {"load_a": size},
        "entropic": {"v_per_k": size},
        "ocv-hysteresis": {"m_v": size},
        "offset": {"offset_a": size},
    }.get(effect, {})


def make(case: dict, out: pathlib.Path) -> None:
    """Writes a case."""
    ids = [effect["id"] for effect in case["effects"]]
    known = (*NATURAL, *PHYSICAL, *RECORDED)
    for effect in ids:
        if effect not in known:
            raise ValueError(f"effects: expected one of {', '.join(known)}, found {effect!r}")
    cell = base_cell(case)
    relaxed = design_of(case)
    design = bare_design(cell) if relaxed == "ocv-resistance" else circuit_design(
        dataclasses.replace(cell, swing_k=0.0, temperature_c=REFERENCE_C), "cell-self-heating" in ids)
    find = Conceal(case, design, cell)
    sizes: dict[str, float] = {}
    stated = design
    for effect in case["effects"]:
        name, strength = effect["id"], effect["strength"]
        if name in PHYSICAL and not cold(name, cell):
            sizes[name] = find.physical(name, strength)
        elif name in RECORDED:
            sizes[name] = find.recorded(name, strength)
        if name == "capacity":
            stated = dataclasses.replace(design, capacity_ah=design.capacity_ah * (1.0 + sizes[name]))
    real = cell
    for name in set(sizes) & set(PHYSICAL):
        real = with_physics(real, name, sizes[name])
    made = [one_drive(case, real, stated, sizes, drive) for drive in (case["drive"], OTHER_DRIVE[case["drive"]])]
    write_case(out, case, *made, stated.lines(case["noise"]), truth(case, real, design, sizes, relaxed))


def one_drive(case: dict, cell: Cell, stated: Design, sizes: dict[str, float], drive: str) -> Made:
    """The cell on a drive, as it is recorded."""
    random = stream(case, f"instruments {drive}")
    current_a = cell.scale * drive_a(drive, case["rows"])
    voltage, temp_c = solved(cell, drive, case["rows"])
    seen_a = current_a
    for name in RECORDED:
        if name in sizes:
            seen_a = recorded_a(name, sizes[name], seen_a)
    columns = {"i_ref_a": seen_a}
    if "cell-self-heating" in sizes:
        known_c = cell.surroundings_c(np.arange(case["rows"]) * STEP_S)
        columns["temp_ambient_c"] = known_c
    else:
        known_c = temp_c + TEMPERATURE_NOISE_K * random.standard_normal(len(temp_c))
        columns["temp_cell_c"] = known_c
    return Made(columns, voltage, stated.voltage(seen_a, known_c))


def truth(case: dict, cell: Cell, design: Design, sizes: dict[str, float], relaxed: str) -> dict:
    """What is concealed, and what else is true of such a cell."""
    ids = [effect["id"] for effect in case["effects"]]
    natural = [name for name in ids if name in NATURAL]
    # At one temperature that is not the design's, all that it does is slow the kinetics (Arrhenius): a smaller exchange current.
    also = {"offset": ["parasitic-load"], "resistance-temperature": ["charge-transfer"] if cold("resistance-temperature", cell) else []}
    required = [[name, *also.get(name, [])] for name in ids if name not in NATURAL]
    if natural:
        required.insert(0, ["diffusion", "polarisation"])
    allowed = list(RELAXATION)
    # Kinetics, or kT/e of them, follow any temperature that is not 25 °C, if the model file does not have it so.
    if design.arrhenius_k == 0.0 and (cell.temperature_c != REFERENCE_C or cell.swing_k or cell.thermal == "lumped"):
        allowed.append("resistance-temperature")
    why = "Relaxation of the cell by diffusion in particles and electrolyte: branches and diffusion are two approximations of it. "
    if relaxed == "relaxation":
        why += ("The design knows it by an equivalent circuit that scipy fitted to another stretch of driving without the effect; "
                "what the circuit leaves is true of the data too.")
    classes = [["diffusion", "polarisation"]]
    if "offset" in ids:
        classes.append(["offset", "parasitic-load"])
        why += " The current has one instrument: a zero error and a consumer that it does not see are the same."
    return {
        "kind": "b", "maker": f"PyBaMM {pybamm.__version__}, {cell.model.upper()}, {cell.parameters}",
        "effects": [{"id": name, "parameters": parameters_of(name, sizes.get(name, 0.0), design)} for name in ids],
        "required": required, "allowed": allowed, "class_ids": classes, "why": why, "where": None,
        "cell": dataclasses.asdict(cell), "sizes": sizes,
    }
