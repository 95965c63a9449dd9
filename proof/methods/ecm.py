"""PyBOP: the Thevenin circuit of PyBaMM (R0 and two RC branches) fitted to the recorded voltage.

What else the design knows (diffusion, RC branches, temperature) is taken off the recorded voltage first, so that the circuit
stands beside it and does not have to imitate it.
"""

from __future__ import annotations

import numpy as np
import pybamm
import pybop

from result import DoesNotApply, Fitted
from series import Series

Array = np.ndarray

# Rows for the fit: neighbouring rows are averaged until no more are left. An evaluation takes 30 ms for this many.
MOST_ROWS = 2000
ITERATIONS = 30
# PyBaMM stops at a state of charge of 0 or 1. Counting may run a little over: its cell is this much larger at either end.
MARGIN = 0.1
STRETCH = 1.0 + 2.0 * MARGIN


def fit(recording: Series) -> Fitted:
    """Maximum likelihood for white noise (least rms), L-BFGS-B with the solver's own sensitivities."""
    if recording.kind != "battery":
        raise DoesNotApply("PyBOP fits batteries; this is a sensor beside its reference")
    if recording.battery.cells != 1.0:
        raise DoesNotApply("PyBOP's circuit is one cell; only a pack's voltage was recorded")
    fitted_rows = averaged(recording)
    data = dataset(*fitted_rows)
    simulator = build(recording, start(recording), data)
    problem = pybop.Problem(simulator, pybop.RootMeanSquaredError(data, target=["Voltage [V]"]))
    options = pybop.SciPyMinimizeOptions(method="L-BFGS-B", jac=True, maxiter=ITERATIONS, tol=1e-8)
    result = pybop.SciPyMinimize(problem, options=options).run()
    found = dict(zip(problem.parameters.names, (float(v) for v in result.x)))

    shift = found.get("Initial SoC", inner(first_soc(recording))) - inner(first_soc(recording))

    def predict(series: Series) -> Array:
        rows = increasing(series)
        values = found | {"Initial SoC": inner(first_soc(series)) + shift}
        solved = build(series, values, dataset(series.t_s[rows], series.x[rows], series.static[rows]))
        voltage = np.asarray(solved.solve()["Voltage [V]"].data)
        if len(voltage) != len(rows):
            raise ValueError(f"PyBaMM stopped after {len(voltage)} of {len(rows)} rows")
        return np.interp(series.t_s, series.t_s[rows], voltage) - series.static

    found_s = {f"tau{k}_s": found[f"R{k} [Ohm]"] * found[f"C{k} [F]"] for k in (1, 2)}
    note = f"fits and chooses nothing; {len(fitted_rows[0])} averaged rows, {ITERATIONS} iterations at most; PyBOP {pybop.__version__}"
    return Fitted([], predict, found | found_s, note)


def first_soc(series: Series) -> float:
    """State of charge of the first row, 0 … 1."""
    return float(series.other["soc"][0])


def start(recording: Series) -> dict[str, pybop.Parameter]:
    """Where the search begins and how far it may go; a state of charge that is not known exactly is found too."""
    ohm = recording.battery.resistance_ohm or 0.01

    def logarithmic(value: float, down: float, up: float) -> pybop.Parameter:
        bounds = [value / down, value * up]
        return pybop.Parameter(bounds=bounds, initial_value=value, transformation=pybop.LogTransformation())

    out = {
        "R0 [Ohm]": logarithmic(ohm, 20.0, 20.0),
        "R1 [Ohm]": logarithmic(0.5 * ohm, 100.0, 40.0),
        "C1 [F]": logarithmic(20.0 / ohm, 200.0, 50.0),
        "R2 [Ohm]": logarithmic(0.5 * ohm, 100.0, 40.0),
        "C2 [F]": logarithmic(400.0 / ohm, 200.0, 200.0),
    }
    if not recording.battery.soc_exact:
        soc = inner(first_soc(recording))
        out["Initial SoC"] = pybop.Parameter(bounds=[soc - 0.07, soc + 0.07], initial_value=soc)
    return out


def inner(soc: float) -> float:
    """State of charge of PyBaMM's larger cell."""
    return (soc + MARGIN) / STRETCH


def build(series: Series, values: dict, data: pybop.Dataset) -> pybop.pybamm.Simulator:
    """The circuit with the design's capacity and OCV, and the given values or parameters."""
    battery = series.battery
    soc = np.concatenate([[-1.0], battery.ocv_soc, [2.0]])
    ocv_v = np.concatenate([battery.ocv_v[:1], battery.ocv_v, battery.ocv_v[-1:]])
    model = pybamm.equivalent_circuit.Thevenin(options={"number of rc elements": 2})
    parameters = model.default_parameter_values
    parameters.update(
        {
            "Cell capacity [A.h]": STRETCH * battery.capacity_ah,
            "Nominal cell capacity [A.h]": battery.capacity_ah,
            "Initial SoC": inner(first_soc(series)),
            "Open-circuit voltage [V]": lambda sto: pybamm.Interpolant(soc, ocv_v, STRETCH * sto - MARGIN),
            "Upper voltage cut-off [V]": 10.0,
            "Lower voltage cut-off [V]": 0.0,
            "Entropic change [V/K]": 0.0,
            # Neither its lookup tables nor its thermal model are used.
            "RCR lookup limit [A]": 1e6,
            "Cell thermal mass [J/K]": 1e9,
            "Element-2 initial overpotential [V]": 0.0,
        },
        check_already_exists=False,
    )
    parameters.update(values, check_already_exists=False)
    solver = pybamm.IDAKLUSolver(on_failure="ignore", atol=1e-6, rtol=1e-6, options={"num_threads": 1})
    return pybop.pybamm.Simulator(model, parameter_values=parameters, protocol=data, solver=solver)


def dataset(t_s: Array, current_a: Array, voltage_v: Array) -> pybop.Dataset:
    """PyBOP's form of a recording; its time begins at 0."""
    return pybop.Dataset({"Time [s]": t_s - t_s[0], "Current [A]": current_a, "Voltage [V]": voltage_v})


def increasing(series: Series) -> Array:
    """Rows whose time is later than all before."""
    latest = np.maximum.accumulate(series.t_s)
    rows = np.concatenate([[0], np.flatnonzero(latest[1:] > latest[:-1]) + 1])
    if len(rows) < 0.9 * len(series.t_s):
        raise DoesNotApply("time starts anew within the recording")
    return rows


def averaged(series: Series) -> tuple[Array, Array, Array]:
    """Time, current and voltage as means over as many neighbouring rows as needed."""
    rows = increasing(series)
    rows = rows[series.valid[rows]]
    width = -(-len(rows) // MOST_ROWS)
    rows = rows[: len(rows) // width * width]
    means = [values[rows].reshape(-1, width).mean(axis=1) for values in (series.t_s, series.x, series.static + series.residual)]
    return means[0], means[1], means[2]
