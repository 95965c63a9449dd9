"""Makes logs and recordings by the tools that others write them with, and what these tools say is in them.

    make_logs.py BOARD.DBC OUT

For each log of CAN frames there is NAME.expected.csv: one line a value, "frame,t_s,column,value", where frame counts the
data frames, t_s counts from the first of them, and column and unit follow this project's rule: <Message>.<Signal> and
the unit's ending. Values come from cantools; of the board's, those that it marks as not valid are left out, and frames
whose end-to-end check fails. For each measurement file there is NAME.expected.csv, "group,t_s,column,value".
"""

import csv
import math
import pathlib
import random
import shutil
import sys

import asammdf
import can
import cantools
import numpy
import pandas
import pyarrow
import pyarrow.parquet

# The same files on each run.
SEED = 20_131_018
FRAMES = 4_000
START = 1_700_000_000.0

# Our units: ending and factor, written down here once more so that the reader is checked.
UNITS = {
    "A": ("_a", 1.0),
    "mA": ("_a", 1e-3),
    "V": ("_v", 1.0),
    "mV": ("_v", 1e-3),
    "kW": ("_w", 1e3),
    "W": ("_w", 1.0),
    "As": ("_as", 1.0),
    "Ah": ("_ah", 1.0),
    "degC": ("_c", 1.0),
    "%": ("_pct", 1.0),
    "mOhm": ("_ohm", 1e-3),
    "Hz": ("_hz", 1.0),
    "ms": ("_s", 1e-3),
    "s": ("_s", 1.0),
}
# The board's own signals that have canonical names.
CANONICAL = {
    "Current.Current": "i_meas_a",
    "Current.CurrentRange": "range_high",
    "Charge.Charge": "q_meas_c",
    "Environment.SensorSupply": "v_supply_v",
    "Environment.SensorTemperature": "temp_sensor_c",
    "StateOfCharge.StateOfCharge": "soc_pct",
    "BatteryVoltage.CellVoltage": "v_cell_v",
    "BatteryVoltage.PackVoltage": "v_pack_v",
    "BatteryVoltage.CellTemperature": "temp_cell_c",
}
MISSING = {"not available", "sna"}
# The signal with the causes against another of the board's: its name and this.
VALIDITY = "Validity"


def crc_of(data_id, payload):
    """AUTOSAR E2E profile 11: over the data ID's low byte, a zero byte and all bytes but the first."""
    crc = 0
    for byte in [data_id & 0xFF, 0, *payload[1:]]:
        crc ^= byte
        for _ in range(8):
            crc = crc << 1 ^ (0x11D if crc & 0x80 else 0)
    return crc


def data_id_of(message):
    attributes = message.dbc.attributes if message.dbc else {}
    profile = attributes.get("E2EProfile")
    return attributes["E2EDataId"].value if profile and profile.value == "P11C" else None


def is_whole(message, payload):
    data_id = data_id_of(message)
    if data_id is None:
        return True
    return payload[0] == crc_of(data_id, payload) and payload[1] >> 4 == data_id >> 8 and payload[1] & 0x0F != 15


def as_the_board_sends(message, payload, rng):
    """Nothing against half of the values, and of ten protected frames nine that are whole."""
    payload = bytearray(payload)
    for signal in message.signals:
        if signal.name.endswith(VALIDITY) and rng.random() < 0.5:
            for bit in range(signal.start, signal.start + signal.length):
                payload[bit // 8] &= ~(1 << bit % 8)
    data_id = data_id_of(message)
    if data_id is not None and rng.random() < 0.9:
        payload[1] = data_id >> 8 << 4 | rng.randrange(15)
        payload[0] = crc_of(data_id, payload)
    return bytes(payload)


def random_frames(database, rng):
    """Data frames with random bytes, now and then other frames between them."""
    time = START
    frames = []
    for _ in range(FRAMES):
        # Some frames share a time stamp; 1 µs is what every format keeps.
        time = round(time + rng.choice([0, 1e-6, 0.001, 0.01]), 6)
        kind = rng.random()
        if kind < 0.01:
            frames.append(can.Message(timestamp=time, is_error_frame=True, channel=0))
        elif kind < 0.03:
            frames.append(can.Message(timestamp=time, arbitration_id=0x7F0, is_extended_id=False, data=[1, 2], channel=0))
        elif kind < 0.05:
            frames.append(
                can.Message(timestamp=time, arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4, channel=0)
            )
        else:
            message = rng.choice(database.messages)
            frames.append(
                can.Message(
                    timestamp=time,
                    arbitration_id=message.frame_id,
                    is_extended_id=message.is_extended_frame,
                    data=random_data(message, rng),
                    channel=0,
                )
            )
    return frames


def random_data(message, rng):
    """Random bytes, in the multiplexers only what the database has a page for: cantools refuses the rest."""
    if message.name == "Nested":
        outer = rng.choice([1, 3, 7, 8, 9])
        inner = rng.choice([2, 3, 4])
        return bytes([inner << 4 | outer]) + rng.randbytes(7)
    if message.name == "Page":
        return bytes([rng.choice([0, 1, 5]) << 4 | rng.randrange(16)]) + rng.randbytes(7)
    if message.name == "Identity":
        return bytes([rng.randrange(6)]) + rng.randbytes(7)
    if message.name == "Shunt" and rng.random() < 0.2:
        return rng.randbytes(5) + b"\xff\xff" + rng.randbytes(1)
    if message.name == "Pack" and rng.random() < 0.2:
        return rng.randbytes(2) + b"\x00\x80" + rng.randbytes(4)
    return as_the_board_sends(message, rng.randbytes(message.length), rng)


def column_of(database_name, message, signal):
    bare = f"{message.name}.{signal.name}"
    if database_name == "board" and bare in CANONICAL:
        return CANONICAL[bare]
    ending, _ = UNITS.get(signal.unit or "", ("", 1.0))
    return bare + ending


def write_expected(path, name, database, frames):
    data = [frame for frame in frames if not frame.is_error_frame and not frame.is_remote_frame]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "t_s", "column", "value"])
        for index, frame in enumerate(data):
            try:
                message = database.get_message_by_frame_id(frame.arbitration_id, frame.is_extended_id)
            except KeyError:
                continue
            if not is_whole(message, frame.data):
                continue
            physical = message.decode(bytes(frame.data), decode_choices=False)
            raws = message.decode(bytes(frame.data), decode_choices=False, scaling=False)
            for signal in message.signals:
                if signal.name not in physical:
                    continue
                value, raw = physical[signal.name], raws[signal.name]
                if name == "board" and raws.get(signal.name + VALIDITY, 0) != 0:
                    continue
                choice = (signal.choices or {}).get(raw)
                if choice is not None and str(choice).lower() in MISSING:
                    continue
                _, factor = UNITS.get(signal.unit or "", ("", 1.0))
                value = float(value) * factor
                if math.isfinite(value):
                    writer.writerow([index, f"{data[index].timestamp - data[0].timestamp:.6f}", column_of(name, message, signal), repr(value)])


def write_all(writer, frames):
    with writer:
        for frame in frames:
            writer.on_message_received(frame)


def make_frames(out, name, database_path, rng):
    database = cantools.database.load_file(database_path, strict=False)
    shutil.copyfile(database_path, out / f"{name}.dbc")
    frames = random_frames(database, rng)
    write_expected(out / f"{name}.expected.csv", name, database, frames)
    write_all(can.CanutilsLogWriter(out / f"{name}.log"), frames)
    write_all(can.ASCWriter(out / f"{name}.asc"), frames)
    # Small containers, so that frames are split over two of them.
    can.BLFWriter.max_container_size = 1_000
    write_all(can.BLFWriter(out / f"{name}.blf", compression_level=9), frames)
    write_all(can.BLFWriter(out / f"{name}-plain.blf", compression_level=0), frames)
    for level in range(3):
        write_all(can.MF4Writer(out / f"{name}-{level}.mf4", compression_level=level), frames)


def make_measurements(out, rng):
    """Groups of measured signals with their own times, each file in another way of storing."""
    generator = numpy.random.default_rng(rng.randrange(2**32))
    rows = 20_000
    fast = numpy.cumsum(generator.choice([0.0, 0.001, 0.002], rows))
    slow = numpy.arange(0, 20, 0.1)
    linear = lambda a, b: {"a": a, "b": b}
    groups = [
        (
            "fast",
            [
                asammdf.Signal(generator.normal(0, 50, rows), fast, name="i_ref_a", unit="A"),
                asammdf.Signal(generator.integers(-30000, 30000, rows).astype("<i2"), fast, name="i_meas_a", unit="mA", conversion=linear(2.5, 7.0)),
                asammdf.Signal(generator.normal(3.7, 0.1, rows).astype("<f4"), fast, name="Cell", unit="V"),
                asammdf.Signal(generator.integers(0, 2, rows).astype("<u1"), fast, name="range_high"),
            ],
        ),
        (
            "slow",
            [
                asammdf.Signal(
                    generator.integers(0, 4096, len(slow)).astype("<u2"), slow, name="temp_cell_c", unit="degC", conversion=linear(0.0625, -40.0)
                ),
                asammdf.Signal(
                    generator.integers(0, 100, len(slow)).astype("<u4"),
                    slow,
                    name="soc_pct",
                    unit="%",
                    invalidation_bits=generator.integers(0, 2, len(slow)).astype(bool),
                ),
                asammdf.Signal(
                    generator.integers(0, 6, len(slow)).astype("<u1"),
                    slow,
                    name="Table",
                    conversion={f"raw_{i}": v for i, v in enumerate([0, 2, 4])} | {f"phys_{i}": v for i, v in enumerate([1.0, 5.0, -3.0])} | {"interpolation": True},
                ),
                asammdf.Signal(
                    generator.integers(1, 200, len(slow)).astype("<i8"),
                    slow,
                    name="Rational",
                    conversion={"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 0.0, "P6": 4.0},
                ),
                asammdf.Signal(
                    generator.integers(0, 4, len(slow)).astype("<u1"),
                    slow,
                    name="State",
                    conversion={"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on", "default": b"?"},
                ),
                asammdf.Signal(numpy.array([b"text"] * len(slow)), slow, name="Remark", encoding="utf-8"),
            ],
        ),
        ("big-endian", [asammdf.Signal(generator.integers(-(2**31), 2**31, len(slow)).astype(">i4"), slow + 0.05, name="Motorola", unit="mV")]),
    ]
    ways = {
        "measured": ("4.10", 0, None),
        "measured-deflate": ("4.10", 1, None),
        "measured-transposed": ("4.11", 2, None),
        "measured-lists": ("4.10", 2, 4_096),
        "measured-420": ("4.20", 1, None),
    }
    for name, (version, compression, fragment) in ways.items():
        with asammdf.MDF(version=version) as mdf:
            if fragment:
                mdf.configure(write_fragment_size=fragment)
            for comment, signals in groups:
                mdf.append(signals, comment=comment, common_timebase=True)
            mdf.save(out / f"{name}.mf4", compression=compression, overwrite=True)
    with asammdf.MDF(out / "measured.mf4") as mdf, open(out / "measured.expected.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["group", "t_s", "column", "value"])
        for index, (_, signals) in enumerate(groups):
            for signal in signals:
                if signal.name == "Remark":
                    continue
                raw = signal.name == "State"
                read = mdf.get(signal.name, group=index, raw=raw, ignore_invalidation_bits=True)
                ending, factor = UNITS.get(signal.unit or "", ("", 1.0))
                column = signal.name if ending and signal.name.endswith(ending) else signal.name + ending
                invalid = numpy.zeros(len(read), bool) if signal.invalidation_bits is None else numpy.asarray(signal.invalidation_bits)
                for time, value, wrong in zip(read.timestamps, read.samples, invalid):
                    if not wrong:
                        writer.writerow([index, repr(float(time)), column, repr(float(value) * factor)])


def make_tables(out, rng):
    """Columns of the types that tools write numbers in, packed in the ways that they choose from."""
    rows = 5_000
    some = lambda value: None if rng.random() < 0.2 else value
    columns = {
        "t_s": pyarrow.array([i * 0.001 for i in range(rows)], pyarrow.float64()),
        "i_ref_a": pyarrow.array([some(rng.gauss(0, 100)) for _ in range(rows)], pyarrow.float64()),
        "v_cell_v": pyarrow.array([some(numpy.float32(rng.gauss(3.7, 0.1))) for _ in range(rows)], pyarrow.float32()),
        "range_high": pyarrow.array([some(rng.random() < 0.5) for _ in range(rows)], pyarrow.bool_()),
        "step": pyarrow.array([some(rng.randrange(-100, 100)) for _ in range(rows)], pyarrow.int8()),
        "cycle": pyarrow.array([i // 100 for i in range(rows)], pyarrow.int64()),
        "count": pyarrow.array([some(rng.randrange(2**32)) for _ in range(rows)], pyarrow.uint32()),
        "remark": pyarrow.array([some("text") for _ in range(rows)], pyarrow.string()),
        "date": pyarrow.array([some(i) for i in range(rows)], pyarrow.timestamp("us")),
    }
    table = pyarrow.table(columns)
    for packing in ["none", "snappy", "gzip", "zstd"]:
        pyarrow.parquet.write_table(
            table, out / f"table-{packing}.parquet", compression=packing, row_group_size=1_999, data_page_version="2.0" if packing == "gzip" else "1.0"
        )
    with open(out / "table.expected.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["group", "t_s", "column", "value"])
        for name, values in columns.items():
            if name in ("t_s", "remark", "date"):
                continue
            for row, value in enumerate(values.to_pylist()):
                if value is not None:
                    writer.writerow([0, repr(row * 0.001), name, repr(float(value))])


def make_texts(out, rng):
    """One table as pandas writes it for spreadsheets of several kinds, below what loggers put above their names."""
    rows = 2_000
    some = lambda value: None if rng.random() < 0.2 else value
    start = pandas.Timestamp("2026-02-28 23:59:30")
    table = pandas.DataFrame(
        {
            "Zeit": [start + pandas.Timedelta(milliseconds=50 * i) for i in range(rows)],
            "Strom [mA]": [some(rng.gauss(0, 1e5)) for _ in range(rows)],
            "Temperatur (°C)": [some(rng.gauss(25, 1)) for _ in range(rows)],
            "Anmerkung; frei": [some('läuft, "sehr" gut') for _ in range(rows)],
        }
    )
    ways = {
        "text-comma": ("utf-8", dict()),
        "text-german": ("cp1252", dict(sep=";", decimal=",", date_format="%d.%m.%Y %H:%M:%S,%f")),
        "text-tabs": ("utf-16", dict(sep="\t", date_format="%Y-%m-%dT%H:%M:%S.%f")),
        "text-clock": ("utf-8", dict(sep=";", date_format="%H:%M:%S.%f")),
    }
    for name, (encoding, how) in ways.items():
        with open(out / f"{name}.csv", "w", newline="", encoding=encoding) as file:
            file.write("Logger 3;Prüfstand 7\r\nSeriennummer;1234\r\n\r\n")
            table.to_csv(file, index=False, lineterminator="\r\n", **how)
    with open(out / "text.expected.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["group", "t_s", "column", "value"])
        for column, name, factor in [("Strom [mA]", "i_ref_a", 1e3), ("Temperatur (°C)", "temp_cell_c", 1.0)]:
            for row, value in enumerate(table[column]):
                if not pandas.isna(value):
                    writer.writerow([0, repr(row * 0.05), name, repr(float(value) / factor)])


def main():
    if len(sys.argv) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    board, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    rng = random.Random(SEED)
    make_frames(out, "vehicle", pathlib.Path(__file__).with_name("vehicle.dbc"), rng)
    make_frames(out, "board", board, rng)
    make_measurements(out, rng)
    make_tables(out, rng)
    make_texts(out, rng)
    (out / "complete").write_text("")
    return 0


if __name__ == "__main__":
    sys.exit(main())
