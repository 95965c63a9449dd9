"""Reads a candump log with python-can and decodes every frame of it with cantools.

    candump_check.py LOG DBC

Prints one JSON object. Exit code 0: every frame is in the DBC, the board's frames are protected and on time; 1: not so;
2: bad input.
"""

import sys

import can

from board_frames import Watch, load
from report import BadInput, Report


def main(arguments):
    """Checks one log."""
    if len(arguments) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        watch = Watch(load(arguments[2]))
        report = Report()
        backwards = []
        last_s = None
        first_s = None
        try:
            with can.CanutilsLogReader(arguments[1]) as log:
                for frame in log:
                    if last_s is not None and frame.timestamp < last_s:
                        backwards.append(f"{frame.timestamp:.6f} s after {last_s:.6f} s")
                    first_s = frame.timestamp if first_s is None else first_s
                    last_s = frame.timestamp
                    if frame.is_error_frame or frame.is_remote_frame:
                        continue
                    watch.take(frame.timestamp, frame.arbitration_id, bytes(frame.data))
        except (OSError, ValueError, IndexError) as error:
            raise BadInput(f"{arguments[1]}: python-can cannot read it: {error}") from error
        watch.report(report)
        report.check_all("time does not run backwards", sum(watch.frames.values()), backwards)
        report.findings["seconds"] = 0 if last_s is None else round(last_s - first_s, 6)
        return report.finish()
    except BadInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv))
