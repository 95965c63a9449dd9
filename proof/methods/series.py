"""A recording beside the simulation as designed: what every method starts from."""

from __future__ import annotations

import pathlib
import tomllib
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from filters import boxcar, by_segment, diffusion, low_pass

Array = np.ndarray

# Signals that are held until their next value (docs/model-file.md).
HELD = {
    "temp_sensor_c": "temperature_c",
    "v_supply_v": "supply_v",
    "i_aux_a": "aux",
    "range_high": "range_high",
}

# Effects that a battery's design may already hold.
KNOWN = ("polarisation", "diffusion", "resistance-temperature")


@dataclass
class Battery:
    """The battery as designed."""

    capacity_ah: float
    resistance_ohm: float
    cells: float
    # Is the resistance, the state of charge at the start, or the zero of the current known exactly?
    resistance_exact: bool
    soc_exact: bool
    current_zero_exact: bool
    # Open-circuit voltage of one cell: state of charge (0 … 1) and V.
    ocv_soc: Array
    ocv_v: Array
    # Is the cell's own temperature recorded, and not its surroundings' alone?
    warmth_recorded: bool = False


@dataclass
class Series:
    """One recording. Units are those of the compared signal unless a name says its own."""

    kind: str  # "sensor" or "battery"
    t_s: Array
    segments: list[slice]
    # What drives the model: the reference (sensor), or the current in A, discharge positive (battery).
    x: Array
    # What the simulation as designed says, what was read, and the difference; NaN where nothing was read.
    simulated: Array
    reading: Array
    residual: Array
    valid: Array
    # Whatever else was recorded: temperature_c, supply_v, aux, range_high; soc (0 … 1), slope_v (dOCV/dSoC).
    other: dict[str, Array] = field(default_factory=dict)
    battery: Battery | None = None
    # OCV(SoC) − R·i alone, in V (battery).
    static: Array | None = None
    full_scale: float = 0.0
    resolution: float = 0.0
    noise: float = 0.0
    # Is a method fitted to it, or is it held out?
    fitted: bool = True

    @property
    def step_s(self) -> float:
        """Median step between two rows, in s."""
        steps = np.diff(self.t_s)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 1.0

    @property
    def span_s(self) -> float:
        """Duration of the longest segment, in s."""
        return max(float(self.t_s[part][-1] - self.t_s[part][0]) for part in self.segments)


def load(folder: pathlib.Path) -> tuple[Series, Series]:
    """Reads recording and held-out recording of a folder."""
    path = folder / "model.toml"
    model = tomllib.loads(path.read_text(encoding="utf-8"))
    for effect in model.get("effects", {}):
        if "battery" not in model or "sensor" in model or effect not in KNOWN:
            raise ValueError(f"{path}: effects.{effect}: the methods know {', '.join(KNOWN)} of a battery as part of a design")
    recording, holdout = (read(folder / name, model) for name in ("recording.csv", "holdout.csv"))
    holdout.fitted = False
    return recording, holdout


def read(path: pathlib.Path, model: dict) -> Series:
    """Reads one recording and simulates it as designed."""
    table = pd.read_csv(path)
    for name, column in model.get("columns", {}).items():
        sign = -1.0 if column.startswith("-") else 1.0
        table[name] = sign * table[column.lstrip("-")]
    segments = split(table)
    if "battery" in model and "sensor" not in model:
        return battery_series(path, table, segments, model["battery"], model.get("effects", {}))
    return sensor_series(path, table, segments, model.get("sensor", {}))


def split(table: pd.DataFrame) -> list[slice]:
    """Stretches without a gap: a gap is longer than 10 median steps and than 5 s, or a clock that starts anew."""
    steps = np.diff(table["t_s"].to_numpy(float))
    forward = steps[steps > 0]
    limit = max(5.0, 10.0 * float(np.median(forward)) if len(forward) else 0.0)
    cuts = np.flatnonzero((steps < 0) | (steps > limit)) + 1
    edges = [0, *cuts.tolist(), len(table)]
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]


def filled(values: pd.Series) -> Array:
    """Straight lines over missing values, so that a filter can run through them; such rows are not scored."""
    return values.astype(float).interpolate(limit_direction="both").to_numpy()


def sensor_series(path: pathlib.Path, table: pd.DataFrame, segments: list[slice], sensor: dict) -> Series:
    """A sensor beside its reference."""
    if sensor.get("front_end", "pair") != "pair":
        raise ValueError(f"{path}: front end {sensor['front_end']!r}; the methods know the plain pair only")
    reference = sensor.get("reference", "i_ref_a" if "i_ref_a" in table else "p_ref_w")
    measured = sensor.get("measured", "p_meas_w" if reference == "p_ref_w" else "i_meas_a")
    t_s = table["t_s"].to_numpy(float)
    x = filled(table[reference])
    window_s = float(sensor.get("window_s", 0.0))
    simulated = by_segment(boxcar, segments, t_s, x, window_s) if window_s > 0 else x
    reading = table[measured].to_numpy(float)
    other = {name: table[column].ffill().bfill().to_numpy(float) for column, name in HELD.items() if column in table}
    other = {name: values for name, values in other.items() if np.isfinite(values).all()}
    return Series(
        kind="sensor",
        t_s=t_s,
        segments=segments,
        x=x,
        simulated=simulated,
        reading=reading,
        residual=reading - simulated,
        valid=np.isfinite(reading) & table[reference].notna().to_numpy(),
        other=other,
        full_scale=float(sensor.get("full_scale", 0.0)),
        resolution=float(sensor.get("step", 0.0)),
        noise=float(sensor.get("noise", 0.0)),
    )


def battery_series(path: pathlib.Path, table: pd.DataFrame, segments: list[slice], settings: dict, known: dict) -> Series:
    """A cell's voltage beside OCV(SoC) − R·i (and what else is known), the state of charge counted from the current."""
    battery = read_battery(path, settings)
    column = settings.get("current", "i_ref_a" if "i_ref_a" in table else "i_meas_a")
    voltage = "v_cell_v" if "v_cell_v" in table else "v_pack_v"
    if voltage == "v_cell_v":
        battery.cells = 1.0
    t_s = table["t_s"].to_numpy(float)
    x = filled(table[column]) - float(settings.get("current_zero_a", 0.0))
    reading = table[voltage].to_numpy(float)
    valid = np.isfinite(reading) & table[column].notna().to_numpy()
    soc = count(t_s, x, battery.capacity_ah, float(settings.get("efficiency", 1.0)))
    soc += initial_soc(settings, battery, reading, x, valid)
    ocv_v = np.interp(soc, battery.ocv_soc, battery.ocv_v)
    static = battery.cells * (ocv_v - battery.resistance_ohm * x)
    step = 0.005
    slope = np.interp(soc + step, battery.ocv_soc, battery.ocv_v) - np.interp(soc - step, battery.ocv_soc, battery.ocv_v)
    other = {"soc": soc, "slope_v": battery.cells * slope / (2 * step)}
    for name in ("temp_cell_c", "temp_ambient_c"):
        if name in table and table[name].notna().any():
            other["temperature_c"] = table[name].ffill().bfill().to_numpy(float)
            break
    battery.warmth_recorded = "temp_cell_c" in table and bool(table["temp_cell_c"].notna().any())
    simulated = static - battery.cells * known_drop(t_s, x, segments, battery, known, other.get("temperature_c"))
    return Series(
        kind="battery",
        t_s=t_s,
        segments=segments,
        x=x,
        simulated=simulated,
        reading=reading,
        residual=reading - simulated,
        valid=valid,
        other=other,
        battery=battery,
        static=static,
    )


def known_drop(
    t_s: Array, x: Array, segments: list[slice], battery: Battery, known: dict, temperature_c: Array | None
) -> Array:
    """Voltage of one cell, in V, that falls beyond the ohmic drop at 25 °C by the effects that the design holds."""
    drop = np.zeros(len(x))
    branches = known.get("polarisation", {})
    for number in (1, 2, 3):
        if f"tau{number}_s" in branches:
            slow = by_segment(low_pass, segments, t_s, x, branches[f"tau{number}_s"], 0.0)
            drop += branches[f"r{number}_ohm"] * slow
    if "diffusion" in known:
        drop += known["diffusion"]["r_ohm"] * by_segment(diffusion, segments, t_s, x, known["diffusion"]["tau_s"])
    if "resistance-temperature" in known and temperature_c is not None:
        factor = np.expm1(known["resistance-temperature"]["b_k"] * (1.0 / (temperature_c + 273.15) - 1.0 / 298.15))
        drop += battery.resistance_ohm * factor * x
    return drop


def read_battery(path: pathlib.Path, settings: dict) -> Battery:
    """The battery's nominal numbers."""
    if "ocv_file" in settings:
        ocv = pd.read_csv(path.parent / settings["ocv_file"])[["soc", "ocv_v"]].to_numpy(float)
    elif "ocv" in settings:
        ocv = np.asarray(settings["ocv"], float)
    else:
        raise ValueError(f"{path}: the model's [battery] needs ocv or ocv_file: the methods compare the voltage")
    return Battery(
        capacity_ah=float(settings["capacity_ah"]),
        resistance_ohm=float(settings.get("ohmic_resistance_ohm", 0.0)),
        cells=float(settings.get("cells", 1.0)),
        resistance_exact=float(settings.get("resistance_uncertainty", 0.0)) == 0.0,
        soc_exact="initial_soc" in settings and float(settings.get("initial_soc_uncertainty", 0.0)) == 0.0,
        current_zero_exact=float(settings.get("current_zero_uncertainty_a", 0.0)) == 0.0,
        ocv_soc=ocv[:, 0],
        ocv_v=ocv[:, 1],
    )


def count(t_s: Array, current_a: Array, capacity_ah: float, efficiency: float) -> Array:
    """Change of the state of charge since the first row, by the trapezoidal rule; also over gaps."""
    steps = np.maximum(np.diff(t_s), 0.0)
    mean = 0.5 * (current_a[1:] + current_a[:-1])
    mean = np.where(mean < 0, efficiency * mean, mean)
    return -np.concatenate([[0.0], np.cumsum(mean * steps)]) / (3600.0 * capacity_ah)


def initial_soc(settings: dict, battery: Battery, reading: Array, current_a: Array, valid: Array) -> float:
    """As stated, else from the first reading of the voltage, plus the ohmic drop."""
    if "initial_soc" in settings:
        return float(settings["initial_soc"])
    first = int(np.flatnonzero(valid)[0])
    rest_v = reading[first] / battery.cells + battery.resistance_ohm * current_a[first]
    return float(np.interp(rest_v, battery.ocv_v, battery.ocv_soc))
