"""Keeps one of the campaign's Python programs running: it and its libraries take seconds to start, a task often less.

    python -c SERVE PROGRAM.py

Each line of standard input is a JSON list of arguments, given to the program's `main(arguments)`; each is answered by a line
`{"code": exit code, "said": what it wrote to standard error}`. Ends with its input.
"""

import contextlib
import importlib
import io
import json
import os
import pathlib
import sys
import traceback

sys.dont_write_bytecode = True


def taken(descriptor: int, mode: str, instead: int):
    """A standard stream for us alone: what the program, its libraries or their children do with it goes elsewhere."""
    mine = os.fdopen(os.dup(descriptor), mode, encoding="utf-8")
    os.dup2(instead, descriptor)
    return mine


def answer(main, arguments: list[str]) -> dict:
    """Runs the program once, as its command line would."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        try:
            code = main(arguments)
        except SystemExit as end:
            # What argparse says of wrong arguments is there already.
            code = end.code
            if isinstance(code, str):
                print(code, file=said)
                code = 1
        except Exception:
            traceback.print_exc(file=said)
            code = 1
    return {"code": code or 0, "said": said.getvalue()}


def serve(program: pathlib.Path) -> None:
    """One task after the other."""
    requests = taken(0, "r", os.open(os.devnull, os.O_RDONLY))
    replies = taken(1, "w", 2)
    sys.path.insert(0, str(program.parent))
    sys.argv = [str(program)]
    main = importlib.import_module(program.stem).main
    for line in requests:
        json.dump(answer(main, json.loads(line)), replies)
        replies.write("\n")
        replies.flush()


serve(pathlib.Path(sys.argv[1]))
