"""What people use today, on the same split as `twin explain`.

    python proof/methods/run.py METHOD FOLDER OUT.json [FOLDER OUT.json …]
    python proof/methods/run.py METHOD --list LIST.json        # [[folder, out], …]

A folder holds recording.csv (fitted), holdout.csv (only predicted) and model.toml (the design).
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pathlib
import sys
import time
import warnings

# One thread: the time is then that of the work.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("PYBAMM_DISABLE_TELEMETRY", "true")

import numpy as np

from result import DoesNotApply, Fitted
from series import Series, load

# Module, function and further arguments of each method.
METHODS: dict[str, tuple[str, str, tuple]] = {
    "straight-line": ("regression", "straight_line", ()),
    "bic": ("regression", "stepwise", (False,)),
    "bic-ar1": ("regression", "stepwise", (True,)),
    "all-at-once": ("regression", "all_at_once", ()),
    "pysindy": ("sindy", "fit", ()),
    "gaussian-process": ("gaussian", "fit", ()),
    "pybop": ("ecm", "fit", ()),
}


def rms(values: np.ndarray, valid: np.ndarray) -> float:
    """Root of the mean square over the rows that were read."""
    return float(np.sqrt(np.mean(values[valid] ** 2)))


def score(method: str, recording: Series, holdout: Series) -> dict:
    """Fits one method to the recording and predicts the other one."""
    module, function, arguments = METHODS[method]
    fit = getattr(importlib.import_module(module), function)
    before = rms(holdout.residual, holdout.valid)
    out = {"method": method, "named": [], "held_out_before_rms": before}
    began = time.process_time()
    try:
        fitted: Fitted = fit(recording, *arguments)
    except DoesNotApply as why:
        return out | {"held_out_rms": None, "recording_rms": None, "seconds": 0.0, "parameters": None, "note": str(why)}
    seconds = time.process_time() - began
    return out | {
        "named": fitted.named,
        "classes": fitted.classes,
        "held_out_rms": rms(holdout.residual - fitted.predict(holdout), holdout.valid),
        "recording_rms": rms(recording.residual - fitted.predict(recording), recording.valid),
        "seconds": seconds,
        "parameters": fitted.parameters,
        "note": fitted.note,
    }


def pairs(arguments: argparse.Namespace) -> list[tuple[str, str]]:
    """Folders and results asked for."""
    if arguments.list:
        return [tuple(pair) for pair in json.loads(pathlib.Path(arguments.list).read_text(encoding="utf-8"))]
    if not arguments.paths or len(arguments.paths) % 2:
        raise ValueError("expected pairs of FOLDER OUT.json, or --list LIST.json")
    return list(zip(arguments.paths[::2], arguments.paths[1::2]))


def write(path: pathlib.Path, result: dict) -> None:
    """Writes a result whole or not at all; JSON knows no NaN."""
    def finite(value: object) -> object:
        if isinstance(value, dict):
            return {key: finite(v) for key, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [finite(v) for v in value]
        if isinstance(value, (float, np.floating)):
            return float(value) if np.isfinite(value) else None
        return value

    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(finite(result), indent=1) + "\n", encoding="utf-8")
    part.replace(path)


def main(arguments: list[str] | None = None) -> int:
    """Exit code 2: an input is not what it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("method", choices=sorted(METHODS))
    parser.add_argument("paths", nargs="*", metavar="FOLDER OUT.json")
    parser.add_argument("--list", metavar="LIST.json")
    wanted = parser.parse_args(arguments)
    warnings.filterwarnings("ignore")
    try:
        for folder, out in pairs(wanted):
            recording, holdout = load(pathlib.Path(folder))
            write(pathlib.Path(out), score(wanted.method, recording, holdout))
    except (OSError, KeyError, ValueError) as why:
        print(f"error: {why!r}" if isinstance(why, KeyError) else f"error: {why}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
