"""Cases from circuits that ngspice simulates with devices of its own (kind b): transistors, diodes, switches, lines, cores.

A drive cycle is the source. A circuit stands between it and the converter; what is concealed is a part that the design does
not know: a tolerance, a rail, a time constant. ngspice knows nothing of the table of effects. Noise is added behind the
simulator: ngspice's transient analysis has none. Circuits are written here; none is a vendor's.

1 V stands for 100 A (magnetic circuits: 1 A for 1 A). The simulation begins LEAD_S before the first row, at its current.
"""

import dataclasses
import pathlib
import subprocess
import tempfile
from collections.abc import Callable

import numpy as np

from case import FULL_SCALE_A, JUST_VISIBLE, SIGMA_A, Made, noise, rms, rounded, write_case
from drives import RECORDINGS, Stretch, stream, stretches
from sensing import EDGES, edge_names

A_PER_V = 100.0
LEAD_S = 2.0
MOST_ROWS = 3000
"""Rows of a stretch: 300 s at 10 Hz, some seconds of ngspice."""
EDGE_S = 1e-4
"""Width of an edge of the range flag."""
TIME_LIMIT_S = 120
TRIES = 12
"""Simulations in search of a strength."""
DRIVES = ("us06", "hwfet")
THERMAL_V = 1.380649e-23 * 300.15 / 1.602176634e-19
"""kT/q at ngspice's 27 °C, in V."""

OPAMP = """
* Operational amplifier of bipolar transistors: differential pair, mirror, common emitter, push-pull output.
.model npn NPN(IS=1e-15 BF=400 VAF=120 TF=0.3n CJE=1p CJC=1p)
.model pnp PNP(IS=1e-15 BF=400 VAF=80 TF=0.3n CJE=1p CJC=1p)
.model dio D(IS=1e-15 N=1 CJO=1p)
.subckt opamp plus minus out vcc vee mismatch=1
Q1 mirror minus tail npn
Q2 first plus tail npn {mismatch}
Q3 mirror mirror vcc pnp
Q4 first mirror vcc pnp
Itail tail vee 100u
Q5 high first vcc pnp
D1 high middle dio
D2 middle low dio
Isink low vee 100u
Cc first high 30p
Q6 vcc high out npn
Q7 vee low out pnp
.ends
"""


@dataclasses.dataclass(frozen=True)
class Circuit:
    """A circuit between `in` and `out`.

    Attributes
    ----------
    netlist : its lines.
    a_per_v : what 1 V at `out` stands for by design, in A.
    values : parameters of the effects that follow from the parts, by effect; empty where none does.
    input_scale : `in` per A of current.
    step_s : longest step of the solver in s.
    reltol : its relative tolerance. With 1e-4 the memory at changes of range falls short by 3 %.
    """

    netlist: str
    a_per_v: float
    values: dict[str, dict[str, float]]
    input_scale: float = 1.0 / A_PER_V
    step_s: float = 0.05
    reltol: float = 1e-6


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of circuit: how it follows from one number that makes the effect larger, and what is right to say of it."""

    circuit: Callable[[float], Circuit]
    devices: str
    required: list[list[str]]
    allowed: list[str]
    why: str
    sources: tuple[str, ...] = ()


def inverter(feedback: str, rails: str = "15", mismatch: float = 1.0) -> str:
    """An inverting amplifier with 10 kΩ at its input and the given parts between `sum` and `out`."""
    return f"""{OPAMP}
Vcc vcc 0 {rails}
Vee vee 0 -15
Rin in sum 10k
{feedback}
Rbias plus 0 5k
X1 plus sum out vcc vee opamp mismatch={mismatch:.9g}
Rload out 0 10k
"""


def lag(size: float) -> Circuit:
    """Capacitor across the feedback: first order."""
    tau_s = 0.01 * size
    return Circuit(inverter(f"Rf sum out 10k\nCf sum out {tau_s / 10e3:.9g}"), -A_PER_V, {"lag": {"tau_s": tau_s}})


def gain(size: float) -> Circuit:
    """A feedback resistor out of tolerance."""
    ratio = 1.0 + 1e-3 * size
    return Circuit(inverter(f"Rf sum out {10e3 * ratio:.9g}"), -A_PER_V, {"gain": {"gain": ratio}})


def offset(size: float) -> Circuit:
    """Input transistors of unequal area."""
    mismatch = float(np.exp(0.01 * size))
    # The offset voltage appears twice at the output of an inverter of gain one.
    offset_a = -2.0 * A_PER_V * THERMAL_V * float(np.log(mismatch))
    return Circuit(inverter("Rf sum out 10k", mismatch=mismatch), -A_PER_V, {"offset": {"offset_a": offset_a}})


def clipping(size: float) -> Circuit:
    """The positive rail is too low: the output transistor saturates."""
    return Circuit(inverter("Rf sum out 10k", rails=f"{1.0 + 6.0 / (1.0 + size):.9g}"), A_PER_V, {}, input_scale=-1.0 / A_PER_V)


def diode_clamp(size: float) -> Circuit:
    """Two diodes with series resistance shunt the output beyond their voltage."""
    return Circuit(f"""
.model clamp D(IS=1e-14 N=1 RS=500)
Rs in out 1k
D1 out a clamp
Va a 0 {6.0 / (1.0 + size):.9g}
D2 b out clamp
Vb b 0 {-6.0 / (1.0 + size):.9g}
""", A_PER_V, {})


def hum(size: float) -> Circuit:
    """A railway's 16.7 Hz leaks into the line over 1 MΩ; read ten times a second it becomes 3.3 Hz."""
    amplitude_a = 0.3 * size
    return Circuit(f"Rs in out 1k\nVmains mains 0 SIN(0 {1001.0 / A_PER_V * amplitude_a:.9g} 16.7)\nRleak mains out 1meg",
                   A_PER_V * 1.001, {"hum": {"frequency_hz": 3.3, "amplitude_a": amplitude_a}})


def offset_temperature(size: float) -> Circuit:
    """A resistor with a temperature coefficient unbalances two equal currents into the summing point."""
    per_k = 1e-4 * size
    return Circuit(inverter(f"""Rf sum out 10k
Vplus five 0 5
Vminus minus5 0 -5
Rdrift five sum R='100k/(1+{per_k:.9g}*(v(temp_c)-25))'
Rfixed minus5 sum 100k"""), -A_PER_V, {"offset-temperature": {"tc_a_per_k": 5.0 / 100e3 * 10e3 * A_PER_V * per_k}})


def gain_temperature(size: float) -> Circuit:
    """A feedback resistor with a temperature coefficient."""
    per_k = 1e-4 * size
    return Circuit(inverter(f"Rf sum out R='10k*(1+{per_k:.9g}*(v(temp_c)-25))'"), -A_PER_V,
                   {"gain-temperature": {"tc_per_k": per_k}})


def self_heating(size: float) -> Circuit:
    """The current's square heats a thermal RC, and the feedback resistor with it."""
    per_a2, tau_s = 1e-7 * size, 45.0
    return Circuit(inverter(f"""Bheat 0 heat I='v(in)*v(in)*{A_PER_V**2:g}'
Rth heat 0 1
Cth heat 0 {tau_s:g}
Rf sum out R='10k*(1+{per_a2:.9g}*v(heat))'"""), -A_PER_V, {"sensor-self-heating": {"tc_per_a2": per_a2, "tau_s": tau_s}})


def supply_ratiometric(size: float) -> Circuit:
    """A bridge of which a part of the supply's movement gets through; the converter's reference stands still."""
    ratio = min(0.01 * size, 1.0)
    span = 0.8 * A_PER_V / FULL_SCALE_A
    a_per_v = FULL_SCALE_A / 2.0
    return Circuit(f"""
Vref ref 0 5
Ra supply_v mixed {10.0 * (1.0 - ratio) + 1e-6:.9g}
Rb mixed ref {10.0 * ratio + 1e-6:.9g}
Ebridge top 0 mixed 0 1
Rtop top tap R='1k*(1-{span:.9g}*v(in))'
Rbottom tap 0 R='1k*(1+{span:.9g}*v(in))'
Vhalf half 0 2.5
Eout out 0 tap half 1
""", a_per_v, {"supply-ratiometric": {"ratio": ratio}})


def core_saturation(size: float) -> Circuit:
    """A core with an air gap around the conductor; its B(H) is a measured ferrite's. The Hall plate reads the gap."""
    area_m2, length_m, gap_m = 1e-4, 0.1, 1e-2 / (1.0 + size)
    h, b = ferrite()
    points = " ".join(f"{value:.6g}" for value in h), " ".join(f"{value:.6g}" for value in b)
    gap = gap_m / (4e-7 * np.pi * area_m2)
    iron = length_m * h[len(h) // 2 + 1] / (b[len(b) // 2 + 1] * area_m2)
    return Circuit(f"""
Gturn 0 wire in 0 1
Aturn (wire 0) (mmf 0) turn
.model turn lcouple(num_turns=1)
Acore (mmf out) ferrite
.model ferrite core(H_array=[{points[0]}] B_array=[{points[1]}] area={area_m2:g} length={length_m:g})
Rgap out 0 {gap:.9g}
""", (gap + iron) / gap, {}, input_scale=1.0)


def ferrite() -> tuple[np.ndarray, np.ndarray]:
    """Field in A/m and flux density in T of recordings/bh-loops/mnzn-ferrite.csv: the middle of the largest loop's branches."""
    table = np.genfromtxt(RECORDINGS / "bh-loops/mnzn-ferrite.csv", delimiter=",", names=True)
    loop = table[table["loop"] == table["loop"].max()]
    h, b = loop["h_a_per_m"], loop["b_t"]
    falls = np.diff(h, prepend=h[-1]) < 0.0
    levels = np.linspace(0.0, 0.98 * b.max(), 12)[1:]

    def field(branch: np.ndarray, level: float) -> float:
        order = np.argsort(b[branch])
        return float(np.interp(level, b[branch][order], h[branch][order]))

    middle = np.array([0.5 * (field(falls, level) + field(~falls, level)) for level in levels])
    return np.concatenate([-middle[::-1], [0.0], middle]), np.concatenate([-levels[::-1], [0.0], levels])


def core_hysteresis(size: float) -> Circuit:
    """Voltage behind a capacitor, clamped by diodes of both directions: follows the current within limits, then stops.

    What is left when the current rests leaks away with the logarithm of time, as a core's after-effect does.
    """
    weight = 0.01 * size
    emission, typical_a = 0.3, 0.5e-6
    lines, total = [], []
    for index, limit_v in enumerate([0.15, 0.25, 0.4]):
        saturation_a = typical_a * np.exp(-limit_v / (emission * THERMAL_V))
        lines.append(f"""C{index} in n{index} 1u
Dup{index} n{index} 0 clamp{index}
Ddown{index} 0 n{index} clamp{index}
.model clamp{index} D(IS={saturation_a:.6g} N={emission})""")
        total.append(f"v(n{index})")
    lines.append(f"Bsum out 0 V='v(in)-{weight:.9g}*({'+'.join(total)})'")
    return Circuit("\n".join(lines), A_PER_V, {})


def core_preisach(size: float) -> Circuit:
    """Hysteresis blocks (Preisach), each less its middle line: no error at full range, memory at zero.

    Each stands there twice, once with input and output turned round: so together they begin demagnetised.
    """
    weight = 1e-3 * size
    lines, total = ["Eturned turned 0 0 in 1"], ["v(in)"]
    for index, (slope, width) in enumerate([(0.1, 0.08), (0.15, 0.12), (0.2, 0.18), (0.3, 0.25), (0.4, 0.35)]):
        lines.append(f"""Ahyst{index} in h{index} hyst{index}
Aturned{index} turned g{index} hyst{index}
.model hyst{index} hyst(in_low={-slope} in_high={slope} hyst={width} out_lower_limit=-1 out_upper_limit=1)
Aline{index} in l{index} line{index}
.model line{index} limit(gain={1.0 / slope:.6g} out_lower_limit=-1 out_upper_limit=1 limit_range=1e-3)""")
        total.append(f"{weight:.9g}*(v(h{index})-v(g{index})-2*v(l{index}))")
    return Circuit("\n".join([*lines, f"Bsum out 0 V='{'+'.join(total)}'"]), A_PER_V, {})


def delay(size: float) -> Circuit:
    """A matched transmission line. With steps much longer than its delay ngspice gives up."""
    delay_s = 0.01 * size
    return Circuit(f"Rs in near 50\nT1 near 0 out 0 Z0=50 TD={delay_s:.9g}\nRt out 0 50", 2.0 * A_PER_V,
                   {"delay": {"delay_s": delay_s}}, step_s=min(0.05, max(2.0 * delay_s, 0.003)))


def moving_average(size: float) -> Circuit:
    """An integrator, and itself behind a transmission line: their difference is the charge within the line's delay."""
    window_s = 0.02 * size
    return Circuit(f"""
Gin 0 area in 0 1
Carea area 0 1 IC=0
Rarea area 0 1e12
.ic v(area)=0
Ebuffer drive 0 area 0 1
Rs drive near 50
T1 near 0 far 0 Z0=50 TD={window_s:.9g}
Rt far 0 50
Bout out 0 V='(v(area)-2*v(far))/{window_s:.9g}'
""", A_PER_V, {"moving-average": {"window_s": window_s}}, step_s=max(0.25 * window_s, 0.002))


def sampled_window(_: float) -> Circuit:
    """A gated integrator: switches let the current in for a part of each period, hand the charge on, and reset.

    Of one size: with a period of less than some rows nobody could see it. Tighter tolerances stop the solver at a switch.
    """
    period_s, duty = 0.37, 0.45
    open_s, short_s = duty * period_s, 0.002 * period_s
    edge_s = 2e-4 * period_s
    first_s = LEAD_S % period_s

    def pulse(from_s: float, length_s: float) -> str:
        return f"PULSE(0 1 {first_s + from_s:.9g} {edge_s:.9g} {edge_s:.9g} {length_s - edge_s:.9g} {period_s:.9g})"

    return Circuit(f"""
.model gate SW(VT=0.5 VH=0.1 RON=50 ROFF=1e12)
Vopen open 0 {pulse(0.0, open_s)}
Vhand hand 0 {pulse(open_s + short_s, short_s)}
Vreset reset 0 {pulse(open_s + 3.0 * short_s, short_s)}
Bgate 0 area I='1e-6*v(in)*v(open)/{open_s:.9g}'
Carea area 0 1u
Sreset area 0 reset 0 gate
Ebuffer copy 0 area 0 1
Shand copy held hand 0 gate
Cheld held 0 1u
.ic v(area)=0 v(held)=0
Eout out 0 held 0 1
""", A_PER_V, {"sampled-window": {"period_s": period_s, "duty": duty}}, reltol=1e-4)


def range_mismatch(size: float) -> Circuit:
    """Two dividers, one for each range; the large one's has a wrong resistor and a wrong zero. Switches choose."""
    lower, zero_v = 1e3 * (1.0 + 2e-3 * size), 2e-3 * size
    share = lower / (1e3 + lower)
    return Circuit(f"""
.model choose SW(VT=0.5 VH=0 RON=1 ROFF=1e12)
Ru in large 1k
Rl large zero {lower:.9g}
Vzero zero 0 {zero_v:.9g}
Ru2 in small 1k
Rl2 small 0 1k
Vone one 0 1
Slarge large out range_high 0 choose
Ssmall small out one range_high choose
Rout out 0 1e9
""", 2.0 * A_PER_V, {"range-mismatch": {"gain_ratio": 2.0 * share, "offset_a": 2.0 * A_PER_V * zero_v * (1.0 - share)}})


def range_handover(size: float) -> Circuit:
    """A low-pass between two switches of range keeps what the old range put into it.

    The same low-pass beside it, in one range, is taken off: the lag alone is known to the design.
    """
    tau_s = 0.001 * size
    return Circuit(f"""
.model choose SW(VT=0.5 VH=0 RON=1 ROFF=1e12)
Vone one 0 1
Etenth tenth 0 in 0 0.1
Ssmall in scaled one range_high choose
Slarge tenth scaled range_high 0 choose
Rload scaled 0 1e9
Efollow follow 0 scaled 0 1
R1 follow kept 10k
C1 kept 0 {tau_s / 10e3:.9g}
R2 in plain 10k
C2 plain 0 {tau_s / 10e3:.9g}
Eten ten 0 kept 0 10
Eback back 0 kept 0 1
Ssmall2 back read one range_high choose
Slarge2 ten read range_high 0 choose
Rload2 read 0 1e9
Bout out 0 V='v(in)+v(read)-v(plain)'
""", A_PER_V, {"range-handover": {"tau_s": tau_s}})


def stray_field(size: float) -> Circuit:
    """The neighbour's field reaches the gap through the air: two conductors, three reluctances."""
    share = 1e-3 * size
    core, gap = 1e6, 4e7
    return Circuit(f"""
Gturn 0 wire in 0 1
Aturn (wire 0) (mmf 0) turn
.model turn lcouple(num_turns=1)
Rcore mmf out {core:g}
Gaux 0 beside aux_a 0 1
Aaux (beside 0) (mmfaux 0) turn
Rair mmfaux out {core / share:.9g}
Rgap out 0 {gap:g}
""", 1.0 + core / gap + share, {"stray-field": {"coupling": share}}, input_scale=1.0)


def dead_band(size: float) -> Circuit:
    """Switches let the signal through beyond a threshold of either sign."""
    threshold_a = size
    return Circuit(f"""
.model beyond SW(VT={threshold_a / A_PER_V:.9g} VH=0 RON=1 ROFF=1e9)
Spos in out in 0 beyond
Sneg in out 0 in beyond
Rdown out 0 10k
""", A_PER_V * 10001.0 / 10e3, {"dead-band": {"threshold_a": threshold_a}})


def eddy_current(size: float) -> Circuit:
    """A part of the signal diffuses through a distributed RC line (URC): a lag of half order."""
    share = min(2e-3 * size, 0.9)
    return Circuit(f"""
.model diffusion URC(K=1.5 FMAX=100 RPERL=1k CPERL=2m)
U1 in far 0 diffusion L=1 N=20
Efar behind 0 far 0 1
Rdirect in out {1.0 / (1.0 - share):.9g}
Rbehind behind out {1.0 / share:.9g}
""", A_PER_V, {})


def resonance(size: float) -> Circuit:
    """A filter of coil and capacitor that rings: second order."""
    damping = 0.15
    turns = 2.0 * damping / (0.004 * size)
    return Circuit(f"L1 in mid 1\nR1 mid out {2.0 * damping * turns:.9g}\nC1 out 0 {1.0 / turns**2:.9g}", A_PER_V, {},
                   step_s=0.01)


def crossover(size: float) -> Circuit:
    """A push-pull output stage with too little bias: neither transistor conducts around zero."""
    bias_v = 0.6 - 0.01 * size
    return Circuit(f"""
.model npn NPN(IS=1e-12 BF=400)
.model pnp PNP(IS=1e-12 BF=400)
Vcc vcc 0 15
Vee vee 0 -15
Vup up in {bias_v:.9g}
Vdown in down {bias_v:.9g}
Q1 vcc up out npn
Q2 vee down out pnp
Rload out 0 10k
""", A_PER_V, {})


CLEAN = "clean"
OPAMP_DEVICES = "bipolar transistors (Gummel–Poon), resistors, capacitors"
KINDS: dict[str, Kind] = {
    CLEAN: Kind(lambda _: Circuit(inverter("Rf sum out 10k"), -A_PER_V, {}), OPAMP_DEVICES, [], [], "nothing is concealed"),
    "lag": Kind(lag, OPAMP_DEVICES, [["lag"]], [], "R·C in the feedback"),
    "gain": Kind(gain, OPAMP_DEVICES, [["gain"]], [], "a resistor of the amplifier"),
    "offset": Kind(offset, OPAMP_DEVICES, [["offset"]], [], "areas of the input transistors: kT/q·ln"),
    "clipping": Kind(clipping, OPAMP_DEVICES, [["clipping", "core-saturation"]], [],
                     "the output stops at a rail; a transistor's saturation rounds the corner"),
    "diode-clamp": Kind(diode_clamp, "diodes", [["core-saturation", "clipping"]], [],
                        "falls short smoothly beyond a knee; no core, but neither row of the table says more of the shape"),
    "hum": Kind(hum, "resistors, sine source", [["hum"]], [], "16.7 Hz, read at 10 Hz: 3.3 Hz"),
    "offset-temperature": Kind(offset_temperature, f"{OPAMP_DEVICES}, resistor by expression", [["offset-temperature"]],
                               ["gain-temperature"], "a current follows the temperature", ("temp_c",)),
    "gain-temperature": Kind(gain_temperature, f"{OPAMP_DEVICES}, resistor by expression", [["gain-temperature"]], [],
                             "the feedback follows the temperature", ("temp_c",)),
    "sensor-self-heating": Kind(self_heating, f"{OPAMP_DEVICES}, resistor and source by expression",
                                [["sensor-self-heating"]], [], "the feedback follows a thermal RC"),
    "supply-ratiometric": Kind(supply_ratiometric, "resistors by expression, controlled source", [["supply-ratiometric"]], [],
                               "a bridge follows its supply", ("supply_v",)),
    "core-saturation": Kind(core_saturation, "XSPICE lcouple and core, B(H) of a measured ferrite",
                            [["core-saturation", "clipping"]], ["gain"],
                            "the ferrite saturates abruptly: a rail is as right; below, its permeability is not constant"),
    "core-hysteresis": Kind(core_hysteresis, "capacitors, diodes", [["core-hysteresis"]], ["lag", "moving-average", "delay"],
                            "memory that follows each turn of the current, as a core with a gap has it; a diode's clamp "
                            "rises with the logarithm of the rate, which is a little lag"),
    "core-preisach": Kind(core_preisach, "XSPICE hyst", [["core-hysteresis"]], [],
                          "memory of the sign of what flowed, as a core without a gap has it; the table's law is another"),
    "delay": Kind(delay, "transmission line (T)", [["delay"]], [], "delay of the line"),
    "moving-average": Kind(moving_average, "capacitor, transmission line (T)", [["moving-average"]], [],
                           "charge within the delay of the line"),
    "sampled-window": Kind(sampled_window, "switches, capacitors", [["sampled-window"]], [], "a gated integrator"),
    "range-mismatch": Kind(range_mismatch, "switches, resistors", [["range-mismatch"]], [], "one divider of two",
                           ("range_high",)),
    "range-handover": Kind(range_handover, "switches, R, C, controlled sources", [["range-handover"]], [],
                           "the low-pass keeps the old range's scale", ("range_high",)),
    "stray-field": Kind(stray_field, "XSPICE lcouple, reluctances", [["stray-field"]], [], "the neighbour's flux", ("aux_a",)),
    "dead-band": Kind(dead_band, "switches", [["dead-band"]], [], "nothing gets through below the threshold"),
    "eddy-current": Kind(eddy_current, "distributed RC line (URC)", [], [], "half order: not in the library"),
    "resonance": Kind(resonance, "L, R, C", [], ["delay"], "second order: not in the library; what is slow is delayed by it"),
    "crossover": Kind(crossover, "bipolar transistors", [], ["dead-band"],
                      "not in the library; around zero it is a dead band, beyond it falls short by a constant"),
}
"""Kinds of circuits by the id of the effect (or the name of what the library lacks)."""


def piecewise(name: str, t_s: np.ndarray, value: np.ndarray) -> str:
    """A voltage source that goes through the points in straight lines."""
    points = [f"{t:.7f} {v:.9g}" for t, v in zip(t_s, value)]
    lines = [" ".join(points[at : at + 8]) for at in range(0, len(points), 8)]
    return f"V{name} {name} 0 PWL(\n+ " + "\n+ ".join(lines) + "\n+ )\n"


def range_flag(stretch: Stretch) -> tuple[np.ndarray, np.ndarray]:
    """Times in s and values of the range flag, its edges around the changes of range, EDGE_S wide at most."""
    changes_s = stretch.changes_s
    # The next change can be closer.
    apart_s = np.diff(changes_s, prepend=-stretch.step_s, append=stretch.t_s[-1] + stretch.step_s)
    half_s = np.minimum(0.5 * EDGE_S, 0.25 * np.minimum(apart_s[:-1], apart_s[1:]))
    times_s = np.concatenate([[0.0], np.stack([changes_s - half_s, changes_s + half_s], axis=1).ravel(), stretch.t_s[-1:]])
    return times_s, (np.arange(len(times_s)) // 2 + stretch.starts_high) % 2.0


def simulate(circuit: Circuit, kind: Kind, stretch: Stretch) -> np.ndarray:
    """The reading at the rows in A, as ngspice has it."""
    t_s = stretch.t_s + LEAD_S
    end_s = t_s[-1]
    text = f"circuit of the proof campaign\n{circuit.netlist}\n"
    text += piecewise("in", t_s, circuit.input_scale * stretch.current_a)
    for name in kind.sources:
        times_s, value = range_flag(stretch) if name == "range_high" else (stretch.t_s, getattr(stretch, name))
        text += piecewise(name, times_s + LEAD_S, value)
    text += f""".options method=gear reltol={circuit.reltol}
.tran {stretch.step_s} {end_s:.6f} 0 {circuit.step_s}
.control
run
set wr_singlescale
wrdata out.txt v(out)
quit
.endc
.end
"""
    with tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "circuit.cir").write_text(text, encoding="utf-8")
        try:
            ran = subprocess.run(
                ["ngspice", "-b", "circuit.cir"], cwd=folder, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False)
        except FileNotFoundError as error:
            raise ValueError("ngspice is not installed (Debian: apt install ngspice)") from error
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"ngspice took longer than {TIME_LIMIT_S} s") from error
        made = pathlib.Path(folder) / "out.txt"
        if not made.exists():
            raise ValueError(f"ngspice: {(ran.stderr or ran.stdout).strip().splitlines()[-1:]}")
        time_s, volts = np.loadtxt(made, unpack=True)
    if time_s[-1] < end_s - 1e-6:
        raise ValueError(f"ngspice stopped at {time_s[-1]:.3f} s of {end_s:.3f} s")
    return circuit.a_per_v * np.interp(t_s, time_s, volts)


def sized(kind: Kind, strength: float, stretch: Stretch) -> tuple[Circuit, np.ndarray]:
    """The circuit that moves the reading by 0.3·strength·SIGMA_A rms (within 10 %, if it can), and its reading in A."""
    target = JUST_VISIBLE * strength * SIGMA_A
    size, small, large = strength, 0.0, np.inf
    last = 0.0
    for _ in range(TRIES):
        circuit = kind.circuit(size)
        reading_a = simulate(circuit, kind, stretch)
        moved = rms(reading_a - stretch.current_a)
        # A circuit that always does more cannot be made weaker.
        if abs(moved / target - 1.0) < 0.1 or target < moved == last:
            break
        last = moved
        small, large = (size, large) if moved < target else (small, size)
        if small > 0.0 and np.isfinite(large):
            size = float(np.sqrt(small * large))
        else:
            size *= float(np.clip(target / moved, 0.25, 4.0))
    return circuit, reading_a


def make(case: dict, out: pathlib.Path) -> None:
    """Writes the case's files."""
    names = [effect["id"] for effect in case["effects"]]
    name = names[0] if names else CLEAN
    if len(names) > 1 or name not in KINDS:
        raise ValueError(f"effects: expected none or one of {', '.join(KINDS)}, found {', '.join(names)}")
    if case["drive"] not in DRIVES:
        raise ValueError(f"drive: expected one of {', '.join(DRIVES)}, found {case['drive']!r}")
    kind = KINDS[name]
    fitted, holdout = stretches(case | {"rows": min(case["rows"], MOST_ROWS)})
    if name == CLEAN:
        circuit = kind.circuit(0.0)
        fitted_a = simulate(circuit, kind, fitted)
    else:
        circuit, fitted_a = sized(kind, case["effects"][0]["strength"], fitted)
    stated = noise(case["noise"])

    def made(stretch: Stretch, quiet_a: np.ndarray, purpose: str) -> Made:
        noise_a = stated.sample(stream(case, purpose), stretch.rows, stretch.step_s)
        return Made(stretch, rounded(quiet_a + noise_a, stated.step_a), quiet_a)

    required, classes, why = kind.required, [ids for ids in kind.required if len(ids) > 1], kind.why
    if name in EDGES:
        same, classes, reason = edge_names(fitted, name, circuit.values[name], stated)
        required, why = [same], f"{why}; {reason}"
    truth = {
        "kind": "b",
        "maker": f"ngspice: {kind.devices}; noise added behind it",
        "effects": [{"id": one, "parameters": circuit.values.get(one)} for one in names],
        "required": required,
        "allowed": kind.allowed,
        "class_ids": classes,
        "why": why,
        "where": None,
    }
    holdout_a = simulate(circuit, kind, holdout)
    write_case(out, made(fitted, fitted_a, "noise"), made(holdout, holdout_a, "noise held out"), stated, truth)
