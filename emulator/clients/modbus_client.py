"""A Modbus client of the running board: pymodbus over TCP or a serial port, with the map as the documents print it.

Reads every register, asks for what the board has to refuse, writes the zero drift, starts calibrations and saves; leaves the
settings as they were. What is refused must have changed nothing.

Prints one JSON object. Exit code 0: all as documented in docs/modbus.md; 1: not so; 2: bad input or no board.
"""

import argparse
import sys
import time

from pymodbus import FramerType, ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.pdu import ExceptionResponse

import modbus_map
from report import BadInput, Report

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE, BUSY = 1, 2, 3, 4, 6
# States of the last command.
RUNNING, DONE, FAILED = 1, 2, 3
# What is under way.
NOTHING, ZERO_DRIFT = 0, 1
# Longest wait for something the board does by itself, in seconds of its uptime.
PATIENCE_S = 30
# The same by the wall clock, should the board stand still.
WALL_PATIENCE_S = 300
# Settings of a front end that is not the one set read 0.
OTHER_FRONT_ENDS = ("dual range: ", "HAH1BV: ", "network: ", "closed loop: ")
# The largest read of the standard.
MAX_READ = 125


def arguments():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--tcp", metavar="HOST:PORT", help="Modbus RTU over TCP")
    where.add_argument("--serial", metavar="DEVICE", help="Modbus RTU on a serial port")
    parser.add_argument("--parity", default="E", choices="NEO", help="of --serial; a pseudo-terminal of Linux takes N only")
    parser.add_argument("--map", required=True, help="docs/modbus.md")
    parser.add_argument("--configuration", required=True, help="docs/configuration.md")
    parser.add_argument("--device", type=int, default=1, help="Modbus address")
    parser.add_argument("--timeout", type=float, default=10.0, help="for an answer, in s by the wall clock")
    parser.add_argument(
        "--state",
        choices=["standstill", "driving"],
        default="standstill",
        help="of the car: standstill is high voltage neither on nor permitted",
    )
    parser.add_argument("--zero", choices=["done", "failed"], default="done", help="how `zero now` has to end")
    parser.add_argument("--cell-voltage-mv", type=int, help="that the board should show as received on CAN")
    parser.add_argument(
        "--repeats", type=int, default=0, help="how many requests in all may stay without an answer and are sent again"
    )
    parser.add_argument("--quick", action="store_true", help="read and refuse, but calibrate and save nothing")
    return parser.parse_args()


def connect(options):
    """The client, connected."""
    common = {"timeout": options.timeout, "retries": 0}
    try:
        if options.tcp:
            host, _, port = options.tcp.rpartition(":")
            client = ModbusTcpClient(host.strip("[]"), port=int(port), framer=FramerType.RTU, **common)
        else:
            client = ModbusSerialClient(
                options.serial, framer=FramerType.RTU, baudrate=115200, parity=options.parity, **common
            )
        if not client.connect():
            raise BadInput(f"no board at {options.tcp or options.serial}")
    except (OSError, ValueError, ModbusException) as error:
        raise BadInput(f"{options.tcp or options.serial}: {error}") from error
    return client


class Board:
    """The board behind pymodbus: every request is counted and has one answer, or is sent again if that is allowed."""

    def __init__(self, client, device, registers, repeats=0):
        self.repeats = repeats
        self.lost = 0
        self.client = client
        self.device = device
        self.map = registers
        self.requests = 0
        self.exceptions = 0

    def ask(self, request, *values, **more):
        """The answer: registers, or the number of the exception."""
        self.requests += 1
        try:
            answer = request(*values, device_id=self.device, **more)
        except ModbusException as error:
            if self.lost == self.repeats:
                raise BadInput(f"request {self.requests}: {error}") from error
            # Said aloud: a lost request is a defect of the board, though one that a master has to live with.
            self.lost += 1
            print(f"request {self.requests} without an answer, sent again: {error}", file=sys.stderr)
            return self.ask(request, *values, **more)
        if isinstance(answer, ExceptionResponse):
            self.exceptions += 1
            return answer.exception_code
        return answer.registers

    def read(self, table, address, count):
        """Registers from `address`: table 3 is holding, 4 is input."""
        request = self.client.read_holding_registers if table == 3 else self.client.read_input_registers
        return self.ask(request, address, count=count)

    def write(self, address, registers):
        """With function 16: the exception, or nothing."""
        answer = self.ask(self.client.write_registers, address, registers)
        return answer if isinstance(answer, int) else None

    def write_one(self, address, register):
        """With function 6: the exception, or nothing."""
        answer = self.ask(self.client.write_register, address, register)
        return answer if isinstance(answer, int) else None

    def row(self, table, row):
        """The values of a row."""
        answer = self.read(table, row.address, row.end - row.address)
        if isinstance(answer, int):
            raise BadInput(f"reading {row.name!r} is refused with exception {answer}")
        return row.values(answer)

    def input(self, name):
        """The first value of an input row."""
        return self.row(4, self.map.input(name))[0]

    def order(self, name):
        """A command: the exception, or nothing."""
        return self.write_one(self.map.holding("command").address, self.map.commands[name])

    def wait(self, condition):
        """Polls until the condition holds; whether it came to hold in time."""
        begin_s = self.input("uptime")
        end = time.monotonic() + WALL_PATIENCE_S
        while not condition():
            if self.input("uptime") - begin_s > PATIENCE_S or time.monotonic() > end:
                return False
        return True

    def configuration(self):
        """What tells whether any setting has changed."""
        return self.input("configuration generation"), self.input("configuration CRC")


class Client:
    """The tests, one after the other."""

    def __init__(self, options, board, report):
        self.options = options
        self.board = board
        self.map = board.map
        self.report = report
        self.standstill = options.state == "standstill"

    def run(self):
        """All tests."""
        before = self.board.row(4, self.map.input("RS485 counters"))
        asked_before, exceptions_before = self.board.requests, self.board.exceptions
        self.report.check(
            "version of the map", self.board.input("map version") == self.map.version, f"{self.map.version:#06x}"
        )
        state = (self.board.input("high voltage"), self.board.input("high-voltage permit"))
        self.report.check(f"the car is in {self.options.state}", (state == (0, 0)) == self.standstill, state)
        self.read_all()
        unchanged = self.board.configuration()
        self.refuse_addresses()
        self.refuse_parts()
        self.refuse_values()
        self.refuse_commands()
        self.report.check(
            "nothing refused has changed anything",
            self.board.configuration() == unchanged,
            f"{unchanged} and {self.board.configuration()}",
        )
        if self.options.cell_voltage_mv is not None:
            self.cell_voltage(self.options.cell_voltage_mv)
        self.zero_drift()
        if self.standstill and not self.options.quick:
            self.zero_now()
            self.supply_calibration()
            self.save()
        after = self.board.row(4, self.map.input("RS485 counters"))
        counted = [later - earlier for earlier, later in zip(before, after)]
        asked = self.board.requests - asked_before
        exceptions = self.board.exceptions - exceptions_before
        self.report.check(
            "the board counts every request and every exception, and no error",
            asked - self.board.lost <= counted[0] <= asked
            and exceptions <= counted[2] <= exceptions + self.board.lost
            and counted[1] <= self.board.lost,
            f"{counted[0]} of {asked} requests, {counted[2]} of {exceptions} exceptions, {counted[1]} errors, "
            f"{self.board.lost} without an answer",
        )

    def expect(self, name, cases):
        """Requests with what has to come of each: (text, expected, answer)."""
        wrong = [
            f"{text}: {'accepted' if answer is None else answer} instead of {expected}"
            for text, expected, answer in cases
            if answer != expected
        ]
        self.report.check_all(name, len(cases), wrong)

    def tables(self):
        """Both tables with the function that reads them."""
        return ((4, self.map.inputs), (3, self.map.holdings))

    def read_all(self):
        """Every row, and runs of rows in one request, which give the same where nothing moves."""
        findings = {}
        differences = []
        runs = 0
        for table, rows in self.tables():
            values = {row.address: self.board.row(table, row) for row in rows}
            findings["inputs" if table == 4 else "holdings"] = {
                row.name: values[row.address] if row.count > 1 else values[row.address][0] for row in rows
            }
            for run in joined(rows):
                answer = self.board.read(table, run[0].address, run[-1].end - run[0].address)
                runs += 1
                if isinstance(answer, int):
                    differences.append(f"function {table} at {run[0].address:#06x}: exception {answer}")
                elif table == 3:
                    at = 0
                    for row in run:
                        length = row.end - row.address
                        if row.values(answer[at : at + length]) != values[row.address]:
                            differences.append(f"{row.name}: differs when read in one request with others")
                        at += length
        self.report.check_all("rows that follow each other are read in one request", runs, differences)
        self.report.findings.update(findings)
        outside = [
            f"{row.name}: {value} is not in {self.map.limits[row.address]}"
            for row in self.map.holdings
            if row.address in self.map.limits and not row.name.startswith(OTHER_FRONT_ENDS)
            for value in as_list(findings["holdings"][row.name])
            if not self.map.limits[row.address][0] <= value <= self.map.limits[row.address][1]
        ]
        self.report.check_all("every setting is within its limits", len(self.map.limits), outside)

    def refuse_addresses(self):
        """Where no register is, and functions that are not there."""
        cases = []
        for table, rows in self.tables():
            taken = {address for row in rows for address in range(row.address, row.end)}
            gaps = sorted({row.end for row in rows} - taken) + [0xFFFF]
            for address in gaps:
                cases.append((f"function {table}, {address:#06x}", ILLEGAL_ADDRESS, code(self.board.read(table, address, 1))))
            last = rows[-1]
            over = code(self.board.read(table, last.address, last.end - last.address + 1))
            cases.append((f"function {table}, over the end", ILLEGAL_ADDRESS, over))
        gap = self.map.holding("command").end
        cases.append(("writing a gap", ILLEGAL_ADDRESS, self.board.write_one(gap, 0)))
        self.expect("registers that do not exist", cases)
        client = self.board.client
        self.expect(
            "functions that the board does not have",
            [
                (name, ILLEGAL_FUNCTION, code(self.board.ask(request, *values, **more)))
                for name, request, values, more in (
                    ("read coils", client.read_coils, (0,), {"count": 1}),
                    ("read discrete inputs", client.read_discrete_inputs, (0,), {"count": 1}),
                    ("write coil", client.write_coil, (0, True), {}),
                    ("mask write", client.mask_write_register, (), {"address": 0x0320, "and_mask": 0, "or_mask": 1}),
                )
            ],
        )

    def refuse_parts(self):
        """A part of a value of 32 or 64 bits."""
        cases = []
        for table, rows in self.tables():
            for row in rows:
                if row.width == 1:
                    continue
                first = code(self.board.read(table, row.address, row.width - 1))
                second = code(self.board.read(table, row.address + 1, row.width - 1))
                cases.append((f"function {table}, first part of {row.name}", ILLEGAL_VALUE, first))
                cases.append((f"function {table}, second part of {row.name}", ILLEGAL_VALUE, second))
        self.expect("reading a part of a wide value", cases)
        cases = []
        for row in self.map.holdings:
            if row.width > 1:
                answer = self.board.write_one(row.address, 0)
                cases.append((f"first register of {row.name}", ILLEGAL_VALUE, answer))
                answer = self.board.write(row.address + 1, [0] * (row.width - 1))
                cases.append((f"the others of {row.name}", ILLEGAL_VALUE, answer))
        self.expect("writing a part of a wide value", cases)

    def refuse_values(self):
        """One beyond each limit of each setting; in the wrong state the state is named."""
        cases = []
        for row in self.map.holdings:
            if row.address not in self.map.limits:
                continue
            low, high = self.map.limits[row.address]
            for value in (low - 1, high + 1):
                if row.limits[0] <= value <= row.limits[1]:
                    frozen = row.writable == "standstill" and not self.standstill
                    expected = FAILURE if frozen else ILLEGAL_VALUE
                    answer = self.board.write(row.address, row.registers([value]))
                    cases.append((f"{row.name} = {value}", expected, answer))
        self.expect("values beyond their limits", cases)

    def refuse_commands(self):
        """Commands without their key, unknown, or without sense now."""
        command = self.map.holding("command").address
        unknown = max(self.map.commands.values()) + 1
        self.expect(
            "commands that are none",
            [(f"{value:#06x}", ILLEGAL_VALUE, self.board.write_one(command, value)) for value in (1, 0x0101, 0x5A00, unknown)],
        )
        self.expect(
            "commands that make no sense now",
            [
                ("finish supply calibration", FAILURE, self.board.order("finish supply calibration")),
                *(
                    []
                    if self.standstill
                    else [
                        (name, FAILURE, self.board.order(name))
                        for name in ("zero now", "start key calibration", "restore", "factory defaults", "clear log")
                    ]
                ),
            ],
        )

    def cell_voltage(self, expected_mv):
        """What another node sends on CAN is shown here."""
        shown = self.board.wait(
            lambda: self.board.input("cell voltage validity") == 0
            and abs(self.board.input("cell voltage") - expected_mv) <= 1
        )
        self.report.check("the cell voltage sent on CAN is shown", shown, f"{self.board.input('cell voltage')} mV")

    def zero_drift(self):
        """Both ranges in one request; the board uses and shows them. They are put back."""
        row = self.map.holding("zero drift")
        before = self.board.row(3, row)
        configuration = self.board.configuration()
        wanted = [12_345, -54_321]
        answer = self.board.write(row.address, row.registers(wanted))
        after = self.board.row(3, row)
        changed = self.board.configuration()
        if not self.standstill:
            self.report.check("the zero drift is not written while driving", answer == FAILURE and after == before, answer)
            return
        self.report.check("the zero drift is written", answer is None and after == wanted, f"{answer}, {after}")
        self.report.check(
            "a change has another generation and CRC, and is not saved",
            changed[0] == configuration[0] + 1
            and changed[1] != configuration[1]
            and self.board.input("configuration saved") == 0,
            f"{configuration} and {changed}",
        )
        limits = self.board.row(3, self.map.holding("zero drift: limit"))
        answer = self.board.write(row.address, row.registers([0, limits[1] + 1]))
        self.report.check(
            "of two values one of which is beyond its limit, none is taken",
            answer == ILLEGAL_VALUE and self.board.row(3, row) == wanted,
            answer,
        )
        answer = self.board.write(row.address, row.registers(before))
        self.report.check(
            "the zero drift is put back",
            answer is None and self.board.row(3, row) == before and self.board.configuration()[1] == configuration[1],
            answer,
        )

    def zero_now(self):
        """A calibration: it is begun, shown, keeps others out, and ends."""
        drift, samples = self.map.holding("zero drift"), self.map.holding("zero drift: samples")
        before = self.board.row(3, drift)
        answer = self.board.order("zero now")
        running = (self.board.input("calibration under way"), self.board.input("command state"))
        self.report.check("zero now is begun", answer is None and running == (ZERO_DRIFT, RUNNING), f"{answer}, {running}")
        self.report.check(
            "the command register reads the last command",
            self.board.row(3, self.map.holding("command")) == [self.map.commands["zero now"]],
        )
        self.expect(
            "what has to wait for the end of a calibration",
            [
                ("zero now", BUSY, self.board.order("zero now")),
                ("start key calibration", BUSY, self.board.order("start key calibration")),
                ("supply point at 0 A", BUSY, self.board.order("supply point at 0 A")),
                ("a setting", BUSY, self.board.write(samples.address, self.board.row(3, samples))),
            ],
        )
        ended = self.board.wait(lambda: self.board.input("calibration under way") == NOTHING)
        outcome = (self.board.input("command state"), self.board.input("command reason"))
        expected = DONE if self.options.zero == "done" else FAILED
        self.report.check(f"zero now ends: {self.options.zero}", ended and outcome[0] == expected, outcome)
        found = self.board.row(3, drift)
        self.report.findings["zero_now"] = {"state": outcome[0], "reason": outcome[1], "drift_ua": found}
        # Another one, ended before its time.
        answer = self.board.order("zero now")
        abort = self.board.order("abort")
        kept = self.board.row(3, drift)
        state = (self.board.input("calibration under way"), self.board.input("command state"))
        self.report.check(
            "a calibration can be aborted and its previous result stays",
            answer is None and abort is None and kept == found and state == (NOTHING, FAILED),
            f"{answer}, {abort}, {state}",
        )
        answer = self.board.write(drift.address, drift.registers(before))
        self.report.check("the zero drift is put back after the calibration", answer is None, answer)

    def supply_calibration(self):
        """The first point begins the calibration where the front end has one, else it is refused, and the reason is told."""
        closed_loop = self.board.row(3, self.map.holding("front end"))[0] == 3
        answer = self.board.order("supply point at 0 A")
        state = (self.board.input("command state"), self.board.input("command reason"))
        points = self.board.row(4, self.map.input("supply points"))
        if closed_loop:
            good = answer is None and state[0] == DONE and points == [1, 0]
        else:
            good = answer == FAILURE and state[0] == FAILED and state[1] != 0 and points == [0, 0]
        self.report.check("a supply point is taken only for a closed-loop sensor", good, f"{answer}, {state}, {points}")
        answer = self.board.order("abort")
        self.report.check("nothing is under way", answer is None and self.board.input("calibration under way") == NOTHING)

    def save(self):
        """The active configuration goes to flash."""
        answer = self.board.order("save")
        saved = self.board.wait(lambda: self.board.input("flash busy") == 0)
        state = (self.board.input("configuration saved"), self.board.input("command state"))
        self.report.check("save", answer is None and saved and state == (1, DONE), f"{answer}, {state}")


def joined(rows):
    """Rows without a gap between them, in runs that one request can read."""
    runs = []
    for row in rows:
        fits = runs and runs[-1][-1].end == row.address and row.end - runs[-1][0].address <= MAX_READ
        if fits:
            runs[-1].append(row)
        else:
            runs.append([row])
    return [run for run in runs if len(run) > 1]


def code(answer):
    """The exception of an answer, nothing when it was accepted."""
    return answer if isinstance(answer, int) else None


def as_list(value):
    """A value or several."""
    return value if isinstance(value, list) else [value]


def main():
    """Runs the client."""
    options = arguments()
    try:
        registers = modbus_map.load(options.map, options.configuration)
        client = connect(options)
        try:
            board = Board(client, options.device, registers, options.repeats)
            report = Report()
            Client(options, board, report).run()
        finally:
            client.close()
        report.findings["requests"] = board.requests
        return report.finish()
    except (BadInput, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
