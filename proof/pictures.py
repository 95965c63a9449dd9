"""Pictures of the campaign out of results.json, one for each claim; what was not measured has no picture.

    python pictures.py RESULTS.json FOLDER
"""

import argparse
import json
import pathlib

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

INK, GREY = "#222222", "#999999"
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
"""Okabe and Ito's palette."""
METHOD_MARKS = {
    "straight-line": ("s", ORANGE), "bic": ("^", RED), "bic-ar1": ("v", PURPLE), "pysindy": ("D", GREEN),
    "gaussian-process": ("P", SKY), "all-at-once": ("X", GREY), "pybop": ("*", INK),
}
KINDS = {"a": "(a) real", "b": "(b) others' simulators", "c": "(c) others' solver", "d": "(d) our own"}
OUTCOMES = [
    ("exact", "right name", GREEN), ("class", "in a named class", SKY), ("quiet", "quiet, rightly", "#8fd3bd"), ("part", "a part", ORANGE),
    ("unknown", "unknown", GREY), ("silent", "silent (weak)", "#dddddd"), ("missed", "missed", "#666666"), ("wrong", "wrong", RED),
    ("error", "failed", "#000000"),
]

plt.rcParams.update({
    "font.size": 9, "font.family": "DejaVu Sans", "axes.spines.top": False,
    "axes.spines.right": False, "axes.edgecolor": INK, "axes.titlesize": 10, "axes.titlelocation": "left", "savefig.dpi": 90,
    "savefig.bbox": "tight", "figure.facecolor": "white",
})


def save(figure, folder: pathlib.Path, name: str) -> None:
    """Writes a picture that is the same whenever it is made."""
    figure.savefig(folder / name, metadata={"Software": None})
    plt.close(figure)


def value(share: dict) -> float:
    """Share in %, NaN of nothing."""
    return 100.0 * share["count"] / share["of"] if share["of"] else float("nan")


def reach(share: dict) -> tuple[float, float]:
    """How far its interval reaches below and above it, in %."""
    middle = value(share)
    return max(middle - 100.0 * share["low"], 0.0), max(100.0 * share["high"] - middle, 0.0)


def real(data: dict, folder: pathlib.Path) -> None:
    """Held-out error of each real recording, over that of the model as designed."""
    lines = [line for line in data["real"] if line["before"] and line["after"]]
    if not lines:
        return
    figure, axes = plt.subplots(figsize=(7.2, 0.42 * len(lines) + 1.4))
    shown = set()
    for place, line in enumerate(lines):
        axes.plot([1.0, line["after"] / line["before"]], [place, place], color=BLUE, lw=1, alpha=0.5)
        axes.plot(line["after"] / line["before"], place, "o", color=BLUE, ms=8, label="twin" if not shown else None, zorder=5)
        shown.add("twin")
        for name, found in line["methods"].items():
            if found["error"] is not None or found["held_out_rms"] is None:
                continue
            mark, colour = METHOD_MARKS.get(name, ("x", INK))
            # A method that diverges is drawn at the edge.
            place_x = min(found["held_out_rms"] / line["before"], 20.0)
            axes.plot(place_x, place, mark, color=colour, ms=6, alpha=0.9, label=None if name in shown else name)
            shown.add(name)
    axes.axvline(1.0, color=INK, lw=1, ls=":")
    axes.set_xscale("log")
    axes.set_yticks(range(len(lines)), [line["id"] for line in lines])
    axes.invert_yaxis()
    axes.set_xlabel("held-out error over that of the model as designed (dotted); beyond 20 at the edge")
    axes.set_title("Real recordings: error on what was never fitted")
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, -0.14 - 0.35 / len(lines)), ncols=4, frameon=False)
    save(figure, folder, "real.png")


def bars(axes, lines: list[dict]) -> None:
    """Outcomes of some groups as stacked bars in %."""
    used = set()
    for place, line in enumerate(lines):
        left = 0.0
        of = sum(count for outcome, count in line["outcomes"].items() if outcome != "unscored")
        for outcome, word, colour in OUTCOMES:
            share = 100.0 * line["outcomes"].get(outcome, 0) / of if of else 0.0
            if share:
                axes.barh(place, share, left=left, color=colour, label=None if word in used else word, edgecolor="white", lw=0.5)
                used.add(word)
                if share > 6:
                    light = colour in ("#dddddd", "#8fd3bd", SKY, ORANGE)
                    axes.text(left + share / 2, place, f"{line['outcomes'][outcome]}", ha="center", va="center",
                              color=INK if light else "white", fontsize=8)
            left += share
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of the cases (numbers: cases)")
    axes.invert_yaxis()
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, -0.18 - 0.5 / max(len(lines), 1)), ncols=5, frameon=False)


def others(data: dict, folder: pathlib.Path) -> None:
    """What was said of the data of others, beside our own."""
    lines = [line for line in data["by_kind"] if line["cases"] > line["outcomes"].get("unscored", 0)]
    if not lines:
        return
    figure, axes = plt.subplots(figsize=(7.2, 0.5 * len(lines) + 1.2))
    bars(axes, lines)
    axes.set_yticks(range(len(lines)), [KINDS[line["name"]] for line in lines])
    axes.set_title("What twin said, by who made the data (all strengths)")
    save(figure, folder, "others.png")


def false_alarms(data: dict, folder: pathlib.Path) -> None:
    """Clean recordings in which something is named."""
    lines = [(f"twin, {KINDS[line['kind']]}", line["named"], BLUE) for line in data["clean"]]
    lines += [(f"{line['name']}, {KINDS[kind]}", share, GREY) for line in data["methods"]
              if line["name"] != "twin" and line["names_effects"] for kind, share in line["false_alarms"].items()]
    lines = [line for line in lines if line[1]["of"]]
    if not lines:
        return
    figure, axes = plt.subplots(figsize=(7.2, 0.36 * len(lines) + 1.0))
    for place, (name, share, colour) in enumerate(lines):
        axes.barh(place, value(share), color=colour, height=0.6)
        axes.errorbar(value(share), place, xerr=np.array([reach(share)]).T, color=INK, capsize=3, lw=1)
        axes.text(102, place, f"{share['count']} of {share['of']}", va="center", fontsize=8)
    axes.axvline(5, color=RED, lw=1, ls="--")
    axes.set_xlim(0, 100)
    axes.set_yticks(range(len(lines)), [name for name, _, _ in lines])
    axes.invert_yaxis()
    axes.set_xlabel("% of clean recordings in which an effect is named, with 95 % interval (dashed: 5 %)")
    axes.set_title("Nothing concealed, and yet something named")
    save(figure, folder, "false-alarms.png")


def methods(data: dict, folder: pathlib.Path) -> None:
    """Right names against time, on others' data and on our own."""
    lines = [line for line in data["methods"] if line["right"]["of"] and line["seconds"]]
    sets = sorted({line["data"] for line in lines})
    if not sets:
        return
    figure, all_axes = plt.subplots(1, len(sets), figsize=(4.2 * len(sets), 3.6), sharey=True, squeeze=False)
    for axes, data_set in zip(all_axes[0], sets):
        for line in (line for line in lines if line["data"] == data_set):
            names = line["names_effects"] or line["name"] == "twin"
            share = value(line["right"]) if names else 0.0
            mark, colour = ("o", BLUE) if line["name"] == "twin" else METHOD_MARKS.get(line["name"], ("x", INK))
            if names:
                axes.errorbar(line["seconds"], share, yerr=np.array([reach(line["right"])]).T, color=colour, lw=1, capsize=3)
            axes.plot(line["seconds"], share, mark, color=colour, ms=9, ls="none", label=line["name"] + ("" if names else " (names none)"))
        axes.set_xscale("log")
        axes.set_ylim(-5, 105)
        axes.margins(x=0.15)
        axes.set_xlabel("processor time of one recording, s (median)")
        axes.set_title(f"data {data_set}")
    all_axes[0][0].set_ylabel("right name or class, %")
    handles = {label: handle for axes in all_axes[0] for handle, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, frameon=False)
    save(figure, folder, "methods.png")


def detection(data: dict, folder: pathlib.Path) -> None:
    """Share of right answers over the strength."""
    lines = data["detection"]
    if not lines:
        return
    strengths = sorted({strength for line in lines for strength, _ in line["strengths"]})
    table = np.full((len(lines), len(strengths)), np.nan)
    for row, line in enumerate(lines):
        for strength, share in line["strengths"]:
            table[row, strengths.index(strength)] = value(share)
    figure, axes = plt.subplots(figsize=(5.6, 0.24 * len(lines) + 1.4))
    image = axes.pcolormesh(table, cmap="cividis", vmin=0, vmax=100, edgecolors="white", lw=1)
    for row in range(len(lines)):
        for column in range(len(strengths)):
            if np.isfinite(table[row, column]):
                axes.text(column + 0.5, row + 0.5, f"{table[row, column]:.0f}", ha="center", va="center", fontsize=7,
                          color="white" if table[row, column] < 55 else INK)
    axes.set_xticks(np.arange(len(strengths)) + 0.5, [f"{strength:g}" for strength in strengths])
    axes.set_yticks(np.arange(len(lines)) + 0.5, [f"{line['effect']} ({line['kind']})" for line in lines])
    axes.invert_yaxis()
    axes.set_xlabel("strength (1: just visible; the reading moves by 0.3 of the noise)")
    axes.set_title("Right name or class, %")
    figure.colorbar(image, ax=axes, pad=0.02, aspect=40)
    save(figure, folder, "detection.png")


def coverage(data: dict, folder: pathlib.Path) -> None:
    """Intervals that have the truth in them."""
    lines = [line for line in data["parameters"] if line["covered"]["of"]]
    if not lines:
        return
    figure, axes = plt.subplots(figsize=(6.4, 0.22 * len(lines) + 1.2))
    for place, line in enumerate(lines):
        share = line["covered"]
        axes.errorbar(value(share), place, xerr=np.array([reach(share)]).T, fmt="o", color=BLUE, ms=4, lw=1, capsize=2)
        axes.text(102, place, f"n = {share['of']}", va="center", fontsize=7)
    axes.axvspan(90, 98, color=GREEN, alpha=0.2, lw=0)
    axes.axvline(95, color=GREEN, lw=1)
    axes.set_xlim(0, 100)
    axes.set_yticks(range(len(lines)), [f"{line['effect']} {line['name']} ({line['kind']})" for line in lines], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("% of the 95 % intervals that have the truth in them (band: 90 … 98 %)")
    axes.set_title("Are the intervals worth their name?")
    save(figure, folder, "coverage.png")


def board(data: dict, folder: pathlib.Path) -> None:
    """Errors of the board before and after the calibration."""
    lines = [line for line in data["board"] if line["calibrated"]]
    if not lines:
        return
    figure, panels = plt.subplots(1, 2, figsize=(7.6, 0.5 * len(lines) + 1.2), sharey=True)
    for axes, what, unit, title in ((panels[0], "", "a", "current, rms, A"), (panels[1], "charge_", "c", "charge at the end, C")):
        for place, line in enumerate(lines):
            for at, when, colour, label in ((-0.18, "before", ORANGE, "as it left the factory"),
                                            (0.18, "after", BLUE, "calibration of twin written back")):
                error = abs(line["calibrated"][f"{what}{when}_{unit}"])
                axes.barh(place + at, error, 0.34, color=colour, label=label if place == 0 else None)
                axes.text(error, place + at, f" {error:.3g}", va="center", fontsize=8)
        axes.margins(x=0.2)
        axes.set_title(title)
    panels[0].set_yticks(range(len(lines)), [line["concealed"] for line in lines])
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False)
    save(figure, folder, "board.png")


def main() -> None:
    """Draws all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    arguments = parser.parse_args()
    data = json.loads(arguments.results.read_text(encoding="utf-8"))
    for name in ("real", "others", "false-alarms", "methods", "detection", "coverage", "board"):
        (arguments.folder / f"{name}.png").unlink(missing_ok=True)
    for draw in (real, others, false_alarms, methods, detection, coverage, board):
        draw(data, arguments.folder)


if __name__ == "__main__":
    main()
