"""Drives of the cases: real current profiles, and the surroundings of the sensor.

The current is a recording's (see recordings/*/README.md: Panasonic 18650PF by P. Kollmeyer, CC BY 4.0; Nissan Leaf cell by
Oak Ridge National Laboratory, MIT; graphics cards by Yang et al., MIT), scaled and put on an even grid along straight lines.
Temperature, supply and the neighbour's current are made up and know nothing of it.
"""

import dataclasses
import functools
import hashlib
import pathlib

import numpy as np
from scipy.signal import lfilter

RECORDINGS = pathlib.Path(__file__).resolve().parents[2] / "recordings"
FINE = 20
"""Steps of the fine grid in one row: what works between rows is calculated there."""
HIGH_A, LOW_A = 53.33, 51.0
"""The large range begins above HIGH_A and ends below LOW_A, by abs(i)."""
LONGEST_STEADY_S = 120.0
"""Longer rests and discharges of the pulse test are cut to this."""


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A stretch of a drive with everything that a sensor meets; all series have a row each.

    Attributes
    ----------
    step_s : time between rows in s; the first row is at 0 s.
    current_a : true current in A, positive = discharge.
    temp_c, supply_v, aux_a : the sensor's temperature in °C, supply in V, and current of a neighbouring conductor in A.
    starts_high : whether the large range measures at first.
    changes_s : times in s of the changes of range, in order.
    """

    step_s: float
    current_a: np.ndarray
    temp_c: np.ndarray
    supply_v: np.ndarray
    aux_a: np.ndarray
    starts_high: bool
    changes_s: np.ndarray

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.current_a)

    @property
    def t_s(self) -> np.ndarray:
        """Time of the rows in s."""
        return np.arange(self.rows) * self.step_s

    @property
    def range_high(self) -> np.ndarray:
        """The range flag at the rows, 0 or 1."""
        return (np.searchsorted(self.changes_s, self.t_s, side="right") + self.starts_high) % 2.0


def stream(case: dict, purpose: str) -> np.random.Generator:
    """Random numbers that follow from the case's seed and id, another row of them for each purpose."""
    digest = hashlib.sha256(f"{case['seed']}:{case['id']}:{purpose}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "big"))


def coloured(random: np.random.Generator, rows: int, correlation_rows: float, rms: float) -> np.ndarray:
    """Noise of first order (AR(1)), in equilibrium from the start; its correlation falls to 1/e in so many rows."""
    kept = np.exp(-1.0 / correlation_rows)
    steps = random.standard_normal(rows) * np.sqrt(1.0 - kept**2)
    steps[0] = random.standard_normal()
    return rms * lfilter([1.0], [1.0, -kept], steps)


def fine_grid(series: np.ndarray) -> np.ndarray:
    """The series on the fine grid: straight lines between rows."""
    rows = np.arange(len(series))
    return np.interp(np.arange((len(series) - 1) * FINE + 1) / FINE, rows, series)


def range_of(current_a: np.ndarray, step_s: float) -> tuple[bool, np.ndarray]:
    """Whether the large range measures at first, and the times in s at which the range changes.

    The comparators see straight lines between rows: up beyond HIGH_A, down below LOW_A, at the crossings themselves.
    """
    high = starts_high = bool(abs(current_a[0]) > HIGH_A)
    changes = []
    for row, (begin, end) in enumerate(zip(current_a[:-1].tolist(), current_a[1:].tolist())):
        # A line through zero goes down and may go up again.
        if high and (begin * end < 0.0 or abs(end) < LOW_A):
            changes.append((row + (np.copysign(LOW_A, begin) - begin) / (end - begin)) * step_s)
            high = False
        if not high and abs(end) > HIGH_A:
            changes.append((row + (np.copysign(HIGH_A, end) - begin) / (end - begin)) * step_s)
            high = True
    return starts_high, np.array(changes)


@functools.cache
def _columns(file: str, *names: str) -> tuple[np.ndarray, ...]:
    table = np.genfromtxt(RECORDINGS / file, delimiter=",", names=True, usecols=names)
    return tuple(table[name] for name in names)


def _even(t_s: np.ndarray, value: np.ndarray, step_s: float) -> np.ndarray:
    return np.interp(np.arange(0.0, t_s[-1], step_s), t_s, value)


def _panasonic(file: str, step_s: float = 0.1, from_s: float = 0.0) -> tuple[float, np.ndarray]:
    # × 19: the truck's pack that the cell stands for, ±400 A.
    t_s, current_a = _columns(f"panasonic-18650pf/{file}", "t_s", "i_ref_a")
    rows = t_s >= from_s
    return step_s, 19.0 * _even(t_s[rows] - from_s, current_a[rows], step_s)


def _leaf() -> tuple[float, np.ndarray]:
    # × 10: ±300 A. The edges of the pulses are recorded once a second, so that is the grid. From the first pulse on.
    t_s, current_a = _columns("leaf-cell/hppc-25c.csv", "t_s", "i_ref_a")
    even = 10.0 * _even(t_s, current_a, 1.0)
    even = even[np.argmax(even > 250.0) - 60 :]
    steady = np.zeros(len(even), dtype=int)
    for row in range(1, len(even)):
        steady[row] = steady[row - 1] + 1 if abs(even[row] - even[row - 1]) < 1.0 else 0
    return 1.0, even[steady <= LONGEST_STEADY_S]


def _gpu() -> tuple[float, np.ndarray]:
    # 1 A for each W beyond the mean: a load that switches every 50 ms.
    t_s, power_w = _columns("gpu-power-sensor/rtx3090-5050-reference.csv", "t_s", "p_ref_w")
    even = _even(t_s, power_w, 0.002)
    return 0.002, even - even.mean()


def _square() -> tuple[float, np.ndarray]:
    # Not a recording: one size of current only, of both signs.
    return 0.1, np.where(np.arange(24000) // 400 % 2 == 0, 100.0, -100.0)


DRIVES = {
    "us06": lambda: _panasonic("25c-us06.csv"),
    "hwfet": lambda: _panasonic("25c-hwfet.csv"),
    # Ten rows for each of the recording, from a lively minute on: what works within 0.1 s shows.
    "us06-fast": lambda: _panasonic("25c-us06.csv", 0.01, 280.0),
    "hppc": _leaf,
    "gpu": _gpu,
    "square": _square,
}
"""Name of a drive and what gives its step in s and its current in A."""


def surroundings(random: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    """Temperature in °C, supply in V and the neighbour's current in A. Told in rows: they vary within any recording."""
    row = np.arange(rows)
    turn = random.uniform(0.0, 2.0 * np.pi, 2)
    return {
        "temp_c": 25.0 + 12.0 * np.sin(row / 4000.0 + turn[0]) + coloured(random, rows, 600.0, 3.0),
        "supply_v": 5.0 + 0.12 * np.sin(row / 1500.0 + turn[1]) + coloured(random, rows, 200.0, 0.03),
        "aux_a": coloured(random, rows, 80.0, 60.0),
    }


CONSTANT = {"temperature": ("temp_c", 40.0), "supply": ("supply_v", 5.2), "aux": ("aux_a", 60.0)}
"""What can be held at one value: the series and the value."""


def stretches(case: dict) -> tuple[Stretch, Stretch]:
    """The fitted stretch of the case's drive, and the one after it: at most `rows` rows each, at most half of the drive.

    `options.constant` names what stands still: "temperature", "supply", "aux", "range" (the large one).
    """
    if case["drive"] not in DRIVES:
        raise ValueError(f"drive: expected one of {', '.join(DRIVES)}, found {case['drive']!r}")
    if case["rows"] < 200:
        raise ValueError(f"rows: expected at least 200, found {case['rows']}")
    step_s, current_a = DRIVES[case["drive"]]()
    rows = min(case["rows"], len(current_a) // 2)
    around = surroundings(stream(case, "surroundings"), 2 * rows)
    constant = case["options"].get("constant", [])
    for what in constant:
        if what not in (*CONSTANT, "range"):
            raise ValueError(f"options.constant: expected {', '.join((*CONSTANT, 'range'))}, found {what!r}")
        if what in CONSTANT:
            name, value = CONSTANT[what]
            around[name] = np.full(2 * rows, value)

    def stretch(part: slice) -> Stretch:
        starts_high, changes_s = (True, np.array([])) if "range" in constant else range_of(current_a[part], step_s)
        return Stretch(step_s, current_a[part], **{name: series[part] for name, series in around.items()},
                       starts_high=starts_high, changes_s=changes_s)

    return stretch(slice(0, rows)), stretch(slice(rows, 2 * rows))
