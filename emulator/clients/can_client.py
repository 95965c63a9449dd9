"""A CAN client of the running board: python-can over socketcand, cantools with board.dbc.

Listens, plays the battery management and the vehicle, sends one frame with a wrong CRC, and falls silent. In each phase it
looks at what the board sends. With --listen-only it leaves the sending to nodes that are there already. All times are the board's, taken from the frames; a slow emulation is no failure.

Prints one JSON object. Exit code 0: all as documented in docs/can.md; 1: not so; 2: bad input or no board.
"""

import argparse
import sys
import time

import can

from board_frames import Watch, load, protect
from report import BadInput, Report

# Phases, in seconds of the board's time. All pages of Identity are out after 1.2 s.
LISTEN_S = 1.5
SILENT_S = 1.5
# docs/can.md: content is missing after 500 ms, and BoardState comes every 100 ms. The rest is for a client that reads late.
TIMEOUT_S = 0.5
REPORTED_S = 0.5
# By the wall clock: without any frame for so long there is no board.
NO_FRAME_S = 20.0
ATTEMPTS = 5


def arguments():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=29536)
    parser.add_argument("--channel", default="can0")
    parser.add_argument("--dbc", required=True, help="can/board.dbc")
    parser.add_argument("--seconds", type=float, default=3.0, help="of sending (or listening only), in the board's time")
    parser.add_argument("--listen-only", action="store_true", help="other nodes send BatteryVoltage and VehicleState")
    parser.add_argument("--cell-voltage", type=float, default=3.6543, help="in V, sent in BatteryVoltage")
    parser.add_argument("--pack-voltage", type=float, default=350.8, help="in V, sent in BatteryVoltage")
    parser.add_argument("--cell-temperature", type=float, default=25.0, help="in degC, sent in BatteryVoltage")
    parser.add_argument("--key", type=int, default=0, help="sent in VehicleState: 0 off, 1 accessory, 2 on, 3 start")
    parser.add_argument("--high-voltage", type=int, default=0, help="sent in VehicleState: 0 off, 1 on")
    parser.add_argument("--current", type=float, help="in A, that the board should measure at the end")
    parser.add_argument("--tolerance", type=float, default=1.0, help="in A, of --current")
    return parser.parse_args()


def connect(options):
    """The bus. The first frame may be stuck to the answer that python-can waits for; then it is tried again."""
    for attempt in range(ATTEMPTS):
        try:
            return can.Bus(
                interface="socketcand", host=options.host, port=options.port, channel=options.channel, tcp_tune=True
            )
        except (can.CanError, OSError, TimeoutError) as error:
            last = error
            time.sleep(0.2 * (attempt + 1))
    raise BadInput(f"no board at {options.host}:{options.port}: {last}")


class Client:
    """The phases, one after the other, driven by the time stamps of the board's frames."""

    def __init__(self, options, database, bus):
        self.options = options
        self.database = database
        self.bus = bus
        self.watch = Watch(database)
        self.now_s = None
        self.counters = {"BatteryVoltage": 0, "VehicleState": 0}
        self.states = []
        self.currents = []
        self.identity_pages = set()

    def receive(self, until_s, sending=False):
        """Takes frames until the board's time is `until_s`, counted from the first frame."""
        quiet_since = time.monotonic()
        next_send_s = self.now_s
        while self.now_s is None or self.now_s < until_s:
            frame = self.bus.recv(timeout=0.5)
            if frame is None:
                if time.monotonic() - quiet_since > NO_FRAME_S:
                    raise BadInput(f"no frame for {NO_FRAME_S:.0f} s")
                continue
            quiet_since = time.monotonic()
            self.take(frame)
            if sending and self.now_s >= next_send_s:
                next_send_s += 0.1
                self.send_all()

    def take(self, frame):
        """Notes what a frame tells."""
        self.now_s = frame.timestamp
        taken = self.watch.take(frame.timestamp, frame.arbitration_id, bytes(frame.data))
        if taken is None:
            return
        message, signals = taken
        if message.name == "BoardState":
            self.states.append((frame.timestamp, signals))
        elif message.name == "Current":
            self.currents.append((frame.timestamp, signals))
        elif message.name == "Identity":
            self.identity_pages.add(signals["IdentityPage"])

    def send(self, name, signals, spoil=0):
        """A frame as the DBC has it, with the next counter."""
        message = self.database.get_message_by_name(name)
        zeros = {f"{name}{end}": 0 for end in ("Crc", "Counter", "IdNibble")}
        data = bytearray(protect(message, message.encode({**zeros, **signals}), self.counters[name]))
        data[0] ^= spoil
        self.counters[name] = (self.counters[name] + 1) % 15
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))

    def send_battery_voltage(self, spoil=0):
        """What the battery management sends."""
        self.send(
            "BatteryVoltage",
            {
                "CellVoltage": self.options.cell_voltage,
                "PackVoltage": self.options.pack_voltage,
                "CellTemperature": self.options.cell_temperature,
            },
            spoil,
        )

    def send_all(self):
        """What battery management and vehicle send every 100 ms."""
        self.send_battery_voltage()
        self.send(
            "VehicleState",
            {"VehicleKeyState": self.options.key, "VehicleHighVoltage": self.options.high_voltage},
        )

    def states_between(self, begin_s, end_s):
        """BoardState in a stretch of time."""
        return [signals for at_s, signals in self.states if begin_s <= at_s <= end_s]

    def check_fresh(self, report, name, begin_s, end_s, expected):
        """Whether BoardState says throughout that both received messages are there, or not."""
        states = self.states_between(begin_s, end_s)
        wrong = [
            f"{signal} {state[signal]}"
            for state in states
            for signal in ("CellVoltageFresh", "VehicleStateFresh")
            if state[signal] != expected
        ]
        report.check_all(name, len(states), wrong)

    def run(self):
        """All phases; the report."""
        report = Report()
        self.receive(until_s=float("-inf"))
        begin_s = self.now_s
        self.receive(begin_s + LISTEN_S)
        sent = [name for name in self.counters if name in self.watch.frames]
        if self.options.listen_only:
            self.listen(report, begin_s)
        elif sent:
            raise BadInput(f"another node sends {' and '.join(sent)}: use --listen-only")
        else:
            self.play(report, begin_s)
        self.watch.report(report)
        report.check("all pages of Identity", self.identity_pages == set(range(6)), sorted(self.identity_pages))
        self.check_current(report)
        report.findings["seconds"] = round(self.now_s - begin_s, 3)
        if self.states:
            report.findings["last_board_state"] = plain(self.states[-1][1])
        return report

    def listen(self, report, begin_s):
        """Other nodes send: the board has to take what they send."""
        refused = self.refused()
        self.receive(begin_s + LISTEN_S + self.options.seconds)
        self.check_fresh(report, "both received: fresh", begin_s + LISTEN_S, self.now_s, 1)
        report.check("no frame was refused", self.refused() == refused, f"{refused} before, {self.refused()} after")

    def play(self, report, begin_s):
        """Sends, sends wrongly and falls silent."""
        self.check_fresh(report, "nothing received: both are missing", begin_s, self.now_s, 0)
        refused = self.refused()

        sending_s = self.now_s
        self.receive(sending_s + self.options.seconds, sending=True)
        self.check_fresh(
            report, "both received: fresh", sending_s + REPORTED_S, self.now_s, 1
        )
        report.check("no frame was refused", self.refused() == refused, f"{refused} before, {self.refused()} after")
        if self.options.high_voltage:
            shown = self.states[-1][1]["HighVoltage"] if self.states else None
            report.check("high voltage is shown as it was sent", shown == 1, shown)

        wrong_s = self.now_s
        self.send_battery_voltage(spoil=0x01)
        self.receive(wrong_s + REPORTED_S)
        report.check(
            "a wrong CRC is refused and counted once",
            refused is not None and (self.refused() - refused) % 256 == 1,
            f"{refused} before, {self.refused()} after",
        )

        self.receive(self.now_s + SILENT_S)
        # The last good frame was before `wrong_s`.
        self.check_fresh(
            report, "silence: both are missing again", wrong_s + TIMEOUT_S + REPORTED_S, self.now_s, 0
        )

    def refused(self):
        """Frames that the board has refused, modulo 256."""
        return self.states[-1][1]["RefusedFrames"] if self.states else None

    def check_current(self, report):
        """The current: new conversions keep coming, the newest is not stale."""
        if not report.check("current frames come", bool(self.currents), f"{len(self.currents)} frames"):
            return
        last_s, last = self.currents[-1]
        recent = [signals for at_s, signals in self.currents if at_s > last_s - 1.0]
        conversions = {signals["CurrentConversions"] for signals in recent}
        report.check("the converter converts", len(conversions) > 1, f"{len(conversions)} conversions in the last second")
        report.check("the current is not stale", int(last["CurrentValidity"]) & 0x01 == 0, last["CurrentValidity"])
        values = [signals["Current"] for signals in recent if int(signals["CurrentValidity"]) & 0x89 == 0]
        if values:
            mean_a = sum(values) / len(values)
            report.findings["current_a"] = {"mean": mean_a, "min": min(values), "max": max(values)}
        if self.options.current is not None:
            report.check(
                "the current is the one expected",
                bool(values) and abs(mean_a - self.options.current) <= self.options.tolerance,
                f"{mean_a if values else None} A, expected {self.options.current} A",
            )


def plain(signals):
    """Signals as JSON takes them."""
    return {name: float(value) if isinstance(value, float) else int(value) for name, value in signals.items()}


def main():
    """Runs the client."""
    options = arguments()
    try:
        database = load(options.dbc)
        with connect(options) as bus:
            return Client(options, database, bus).run().finish()
    except (BadInput, can.CanError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
