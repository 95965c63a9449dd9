"""Checks the frames of core-logic against board.dbc as cantools reads it.

    check.py decode  board.dbc OURS       cantools decodes each of our frames to the values we say it carries
    check.py make    board.dbc            prints frames that cantools encodes
    check.py compare board.dbc THEIRS OURS  our encoder's bytes for THEIRS are cantools's bytes

A frame is one line of JSON: {"message": NAME, "id": ID, "data": HEX, "signals": {NAME: PHYSICAL VALUE, ...}}.
Exit code 0: all equal, 1: a difference, 2: bad input.
"""

import json
import random
import sys
from decimal import Decimal

import cantools

# The same frames on each run.
SEED = 20_131_018
FRAMES_PER_MESSAGE = 200
# Differences shown before the rest is only counted.
SHOWN = 20


class BadInput(Exception):
    """A file is not what it should be."""


def read_frames(path):
    """The frames of a file, each with its line number; numbers keep every digit."""
    frames = []
    with open(path, encoding="utf-8") as file:
        for number, line in enumerate(file, start=1):
            try:
                frames.append((number, json.loads(line, parse_float=Decimal, parse_int=Decimal)))
            except ValueError as error:
                raise BadInput(f"{path}:{number}: {error}") from error
    if not frames:
        raise BadInput(f"{path}: no frames")
    return frames


def raw_value(signal, physical):
    """The integer on the bus for a physical value; exact, so that a value between two steps shows."""
    return (Decimal(physical) - exact(signal.offset)) / exact(signal.scale)


def exact(number):
    """A number of the DBC as it is written there."""
    return Decimal(repr(number)) if isinstance(number, float) else Decimal(number)


def raw_limits(signal):
    """The raw values a signal may carry: its bits, narrowed by the limits the DBC gives."""
    if signal.is_signed:
        low, high = -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    else:
        low, high = 0, (1 << signal.length) - 1
    for limit in (signal.minimum, signal.maximum):
        if limit is not None and raw_value(signal, exact(limit)) % 1 != 0:
            raise BadInput(f"{signal.name}: the DBC's limit {limit} is between two steps")
    if signal.minimum is not None:
        low = max(low, int(raw_value(signal, exact(signal.minimum))))
    if signal.maximum is not None:
        high = min(high, int(raw_value(signal, exact(signal.maximum))))
    return low, high


def active_signals(message, raw):
    """The signals a frame with these raw values has, where a multiplexer chooses among them."""
    active = []
    for signal in message.signals:
        if signal.multiplexer_ids is not None and raw.get(signal.multiplexer_signal) not in signal.multiplexer_ids:
            continue
        active.append(signal)
    return active


def decode(database, path):
    """Every frame's signals, by cantools, against the values that came with it."""
    seen = {}
    differences = []
    for number, frame in read_frames(path):
        place = f"{path}:{number}"
        try:
            message = database.get_message_by_name(frame["message"])
            data = bytes.fromhex(frame["data"])
            frame_id, signals = int(frame["id"]), frame["signals"]
        except KeyError as error:
            raise BadInput(f"{place}: no message or member {error}") from error
        except ValueError as error:
            raise BadInput(f"{place}: {error}") from error
        if frame_id != message.frame_id:
            differences.append(f"{place}: {message.name} has identifier {frame_id:#x}, the DBC {message.frame_id:#x}")
        if len(data) != message.length:
            differences.append(f"{place}: {message.name} has {len(data)} bytes, the DBC {message.length}")
            continue
        decoded = message.decode(data, decode_choices=False, scaling=False)
        if set(decoded) != set(signals):
            differences.append(f"{place}: {message.name} has signals {sorted(signals)}, the DBC {sorted(decoded)}")
            continue
        for name, raw in decoded.items():
            expected = raw_value(message.get_signal_by_name(name), signals[name])
            if expected != raw:
                differences.append(f"{place}: {message.name}.{name} is {raw} on the bus, {expected} was meant")
        seen[message.name] = seen.get(message.name, 0) + 1
    missing = [message.name for message in database.messages if message.name not in seen]
    if missing:
        differences.append(f"{path}: no frame of {', '.join(missing)}")
    return report(f"{sum(seen.values())} of our frames ({len(seen)} messages) decoded by cantools", differences)


def make(database):
    """Prints frames with random and extreme values, encoded by cantools."""
    chance = random.Random(SEED)
    for message in database.messages:
        limits = {signal.name: raw_limits(signal) for signal in message.signals}
        for number in range(FRAMES_PER_MESSAGE):
            raw = {}
            for signal in message.signals:
                low, high = limits[signal.name]
                if signal.is_multiplexer:
                    raw[signal.name] = chance.choice(multiplexer_values(message, signal.name))
                else:
                    # First all lowest, then all highest, then any mixture of both and of what lies between.
                    raw[signal.name] = (
                        low if number == 0 else high if number == 1
                        else chance.choice([low, high, chance.randint(low, high), chance.randint(low, high)])
                    )
            raw = {signal.name: raw[signal.name] for signal in active_signals(message, raw)}
            data = message.encode(raw, scaling=False, padding=False, strict=True)
            physical = {
                name: str(value * exact(message.get_signal_by_name(name).scale)
                          + exact(message.get_signal_by_name(name).offset))
                for name, value in raw.items()
            }
            # Numbers are put in as they are, because a float would lose digits of a 64-bit signal.
            members = ", ".join(f"{json.dumps(name)}: {plain(value)}" for name, value in physical.items())
            print(
                f'{{"message": {json.dumps(message.name)}, "id": {message.frame_id}, '
                f'"data": "{data.hex()}", "signals": {{{members}}}}}'
            )
    return 0


def multiplexer_values(message, name):
    """The values of a multiplexer for which the DBC has signals."""
    values = {
        value
        for signal in message.signals
        if signal.multiplexer_signal == name
        for value in signal.multiplexer_ids or []
    }
    return sorted(values) or [0]


def plain(text):
    """A decimal number without an exponent."""
    return format(Decimal(text), "f")


def compare(database, theirs, ours):
    """Our encoder's bytes against those of cantools, line by line."""
    expected = read_frames(theirs)
    with open(ours, encoding="utf-8") as file:
        encoded = file.read().split()
    differences = []
    if len(encoded) != len(expected):
        differences.append(f"{ours}: {len(encoded)} frames for {len(expected)}")
    for (number, frame), data in zip(expected, encoded):
        if frame["data"] != data.lower():
            signals = ", ".join(f"{name} = {value}" for name, value in frame["signals"].items())
            differences.append(f"{frame['message']} (line {number}): ours {data}, cantools {frame['data']}: {signals}")
    return report(
        f"{len(expected)} frames of cantools ({len(database.messages)} messages) reproduced by our encoder", differences
    )


def report(what, differences):
    """Prints the result; the exit code."""
    for difference in differences[:SHOWN]:
        print(f"   {difference}")
    if len(differences) > SHOWN:
        print(f"   and {len(differences) - SHOWN} more")
    if differences:
        print(f"   {what}: {len(differences)} differences")
        return 1
    print(f"   {what}: all equal")
    return 0


def main(arguments):
    """Runs one of the three commands."""
    commands = {"decode": (decode, 1), "make": (make, 0), "compare": (compare, 2)}
    if len(arguments) < 2 or arguments[0] not in commands or len(arguments) != 2 + commands[arguments[0]][1]:
        print(__doc__, file=sys.stderr)
        return 2
    command, _ = commands[arguments[0]]
    try:
        database = cantools.database.load_file(arguments[1], strict=True)
        if not database.messages:
            raise BadInput(f"{arguments[1]}: no messages")
        return command(database, *arguments[2:])
    except (BadInput, OSError, cantools.database.Error) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
