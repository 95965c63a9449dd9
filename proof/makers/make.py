"""Makes cases of the proof campaign: reads CASE.json, writes the case's files to OUTDIR.

    python make.py CASE.json OUTDIR [CASE.json OUTDIR ...]
    python make.py --list LIST.json        # [["CASE.json", "OUTDIR"], ...]

Exit code 0: all made; 2: at least one could not be, and nothing of it is left behind.
"""

import argparse
import importlib
import json
import os
import pathlib
import sys
import tempfile

sys.dont_write_bytecode = True

MAKERS = ("sensing", "circuits", "cells", "battery")
NOISES = ("white", "coloured", "quantised", "none")
FIELDS = {
    "id": str, "maker": str, "effects": list, "noise": str, "drive": str, "seed": int, "rows": int, "options": dict,
}


def checked(case: object, where: str) -> dict:
    """The case, if it is one; ValueError says where and what was expected."""
    if not isinstance(case, dict):
        raise ValueError(f"{where}: expected an object")
    for field, kind in FIELDS.items():
        if field not in case and field == "options":
            case["options"] = {}
        if not isinstance(case.get(field), kind) or isinstance(case[field], bool):
            raise ValueError(f"{where}: {field}: expected {kind.__name__}, found {case.get(field)!r}")
    if case["maker"] not in MAKERS:
        raise ValueError(f"{where}: maker: expected one of {', '.join(MAKERS)}, found {case['maker']!r}")
    if case["noise"] not in NOISES:
        raise ValueError(f"{where}: noise: expected one of {', '.join(NOISES)}, found {case['noise']!r}")
    for index, effect in enumerate(case["effects"]):
        is_effect = isinstance(effect, dict) and isinstance(effect.get("id"), str)
        strength = effect.get("strength") if is_effect else None
        if isinstance(strength, bool) or not isinstance(strength, (int, float)) or not strength > 0:
            raise ValueError(f'{where}: effects[{index}]: expected {{"id": …, "strength": above 0}}, found {effect!r}')
    return case


def read(path: pathlib.Path) -> object:
    """Contents of a JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: not JSON: {error}") from error


def make(case_path: pathlib.Path, out: pathlib.Path) -> None:
    """Makes one case; its files appear in `out` when all of them are complete."""
    case = checked(read(case_path), str(case_path))
    maker = importlib.import_module(case["maker"])
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".making-") as made:
        try:
            maker.make(case, pathlib.Path(made))
        except (ValueError, RuntimeError, OSError) as error:
            raise ValueError(f"{case_path}: {case['id']}: {error}") from error
        out.mkdir(exist_ok=True)
        for file in pathlib.Path(made).iterdir():
            os.replace(file, out / file.name)


def pairs(arguments: argparse.Namespace) -> list[tuple[pathlib.Path, pathlib.Path]]:
    """Cases and folders that the command line names."""
    if arguments.list:
        listed = read(arguments.list)
        is_list = isinstance(listed, list) and all(
            isinstance(pair, list) and len(pair) == 2 and all(isinstance(part, str) for part in pair) for pair in listed)
        if not is_list:
            raise ValueError(f'{arguments.list}: expected [["CASE.json", "OUTDIR"], …]')
    else:
        flat = arguments.pairs
        if not flat or len(flat) % 2:
            raise ValueError("expected pairs of CASE.json and OUTDIR, or --list LIST.json")
        listed = list(zip(flat[::2], flat[1::2]))
    return [(pathlib.Path(case), pathlib.Path(out)) for case, out in listed]


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description="Make cases of the proof campaign.")
    parser.add_argument("pairs", nargs="*", metavar="CASE.json OUTDIR")
    parser.add_argument("--list", type=pathlib.Path, metavar="LIST.json")
    try:
        wanted = pairs(parser.parse_args(arguments))
    except ValueError as error:
        print(f"make.py: {error}", file=sys.stderr)
        return 2
    failed = 0
    for case, out in wanted:
        try:
            make(case, out)
        except ValueError as error:
            print(f"make.py: {error}", file=sys.stderr)
            failed = 2
    return failed


if __name__ == "__main__":
    sys.exit(main())
