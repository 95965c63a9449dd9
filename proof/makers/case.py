"""What all cases of a current sensor have in common: noise, the files, the truth."""

import dataclasses
import json
import pathlib

import numpy as np

from drives import Stretch, coloured

SIGMA_A = 0.5
"""Noise of one reading in A, rms, whatever its kind. Strength 1 moves the reading by 0.3 of it, rms."""
JUST_VISIBLE = 0.3
FULL_SCALE_A = 600.0
RANGE_LIMIT_A = 53.33
COLOURED_TAU_S = 2.0
WHITE_BESIDE = 0.3
"""White noise beside the coloured one, and before the converter's step in units of that step."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """White and coloured noise in A, rms, and the converter's step in A (0: continuous)."""

    white_a: float = 0.0
    coloured_a: float = 0.0
    step_a: float = 0.0

    def sample(self, random: np.random.Generator, rows: int, step_s: float) -> np.ndarray:
        """Noise of so many rows in A; without the converter's step, which comes last."""
        white = self.white_a * random.standard_normal(rows)
        return white + coloured(random, rows, COLOURED_TAU_S / step_s, self.coloured_a)

    @property
    def rms_a(self) -> float:
        """All of it, a step counted as evenly spread."""
        return float(np.sqrt(self.white_a**2 + self.coloured_a**2 + self.step_a**2 / 12.0))


def noise(kind: str) -> Noise:
    """The noise of a case; each kind has an rms of SIGMA_A in all."""
    if kind == "white":
        return Noise(white_a=SIGMA_A)
    if kind == "coloured":
        part_a = SIGMA_A / np.sqrt(1.0 + WHITE_BESIDE**2)
        return Noise(white_a=WHITE_BESIDE * part_a, coloured_a=part_a)
    if kind == "quantised":
        step_a = SIGMA_A / np.sqrt(WHITE_BESIDE**2 + 1.0 / 12.0)
        return Noise(white_a=WHITE_BESIDE * step_a, step_a=step_a)
    return Noise()


def rounded(value: np.ndarray, step_a: float) -> np.ndarray:
    """To the nearest multiple of the step in A; 0: as it is."""
    return np.round(value / step_a) * step_a if step_a > 0.0 else value


def rms(value: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(value))))


def write_recording(path: pathlib.Path, stretch: Stretch, reading_a: np.ndarray) -> None:
    """A recording in canonical columns."""
    columns = {
        "t_s": stretch.t_s, "i_ref_a": stretch.current_a, "i_meas_a": reading_a, "range_high": stretch.range_high,
        "v_supply_v": stretch.supply_v, "temp_sensor_c": stretch.temp_c, "i_aux_a": stretch.aux_a,
    }
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="", fmt="%.7g")


def write_model(path: pathlib.Path, noise: Noise) -> None:
    """The sensor as designed. The reference is exact: it is what the reading was made from."""
    lines = [
        "schema = 1",
        'name = "current sensor of two ranges, 600 A"',
        "",
        "[sensor]",
        'front_end = "pair"',
        f"full_scale = {FULL_SCALE_A:g}",
        f"range_limit = {RANGE_LIMIT_A:g}",
    ]
    stated = {"noise": noise.white_a, "noise_coloured": noise.coloured_a, "step": noise.step_a}
    lines += [f"{key} = {value:.6g}" for key, value in stated.items() if value > 0.0]
    if noise.coloured_a > 0.0:
        lines.append(f"noise_coloured_tau_s = {COLOURED_TAU_S:g}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclasses.dataclass(frozen=True)
class Made:
    """One stretch with the reading in A: with its noise, and as the physics alone would have it."""

    stretch: Stretch
    reading_a: np.ndarray
    quiet_a: np.ndarray


def write_case(out: pathlib.Path, fitted: Made, holdout: Made, noise: Noise, truth: dict) -> None:
    """Recording, held-out recording, model file and truth."""
    both = {"recording": fitted, "holdout": holdout}
    for name, made in both.items():
        write_recording(out / f"{name}.csv", made.stretch, made.reading_a)
    write_model(out / "model.toml", noise)
    truth = truth | {
        "noise_rms": noise.rms_a,
        "oracle_rms": {name: rms(made.reading_a - made.quiet_a) for name, made in both.items()},
        "before_rms": {name: rms(made.reading_a - made.stretch.current_a) for name, made in both.items()},
    }
    (out / "truth.json").write_text(json.dumps(truth, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
