"""The frames of board.dbc as a third party reads them: cantools for the signals, crccheck for the end-to-end CRC.

Everything comes from the DBC: identifiers, periods, which messages are protected and with which data ID.
"""

import cantools
from crccheck.crc import Crc8Base

from report import BadInput

# The node of the DBC that is the board.
BOARD = "HALLMARK"
# A frame may be late by the arbitration with the frames of the same tick.
PERIOD_TOLERANCE_S = 0.003


class Profile11Crc(Crc8Base):
    """CRC-8 of AUTOSAR E2E profile 11: SAE J1850's polynomial, start and final XOR 0 (the DBC's comment on each CRC)."""

    _poly = 0x1D
    _initvalue = 0x00
    _reflect_input = False
    _reflect_output = False
    _xor_output = 0x00


def load(path):
    """The database."""
    try:
        database = cantools.database.load_file(path, strict=True)
    except (OSError, cantools.database.Error) as error:
        raise BadInput(f"{path}: {error}") from error
    if not any(BOARD in message.senders for message in database.messages):
        raise BadInput(f"{path}: no message is sent by {BOARD}")
    return database


def attribute(message, name):
    """An attribute of a message, the default where it has none of its own."""
    own = message.dbc.attributes.get(name)
    return own.value if own is not None else message.dbc.attribute_definitions[name].default_value


def data_id(message):
    """The data ID of a protected message, else nothing."""
    return int(attribute(message, "E2EDataId")) if attribute(message, "E2EProfile") == "P11C" else None


def crc(identifier, data):
    """The CRC that belongs into byte 0."""
    return Profile11Crc.calc(bytes([identifier & 0xFF, 0]) + bytes(data[1:]))


def protect(message, data, counter):
    """The frame with counter, data ID nibble and CRC."""
    identifier = data_id(message)
    data = bytearray(data)
    data[1] = (identifier >> 8) << 4 | counter
    data[0] = crc(identifier, data)
    return bytes(data)


def end_to_end_fault(message, data):
    """What is wrong with a protected frame, or nothing."""
    identifier = data_id(message)
    if identifier is None:
        return None
    if data[0] != crc(identifier, data):
        return "wrong CRC"
    if data[1] >> 4 != identifier >> 8:
        return "wrong data ID"
    if data[1] & 0x0F == 15:
        return "reserved counter 15"
    return None


class Watch:
    """Looks at every frame of the bus: decodes it, checks its protection, its counter and its period."""

    def __init__(self, database):
        self.database = database
        self.frames = {}
        self.faults = []
        self.foreign_faults = 0
        self.not_decoded = []
        self.late = []
        self.intervals = {}
        self._last = {}

    def take(self, at_s, frame_id, data):
        """Message and raw signals of a frame; nothing when it is not in the database or cannot be decoded."""
        try:
            message = self.database.get_message_by_frame_id(frame_id)
            signals = message.decode(data, decode_choices=False, allow_truncated=False)
        except (KeyError, ValueError, cantools.database.Error) as error:
            self.not_decoded.append(f"{at_s:.6f} s: {frame_id:03X}#{data.hex().upper()}: {error!r}")
            return None
        self.frames[message.name] = self.frames.get(message.name, 0) + 1
        ours = BOARD in message.senders
        for fault in self._faults(message, at_s, data):
            if ours:
                self.faults.append(f"{at_s:.6f} s: {message.name}: {fault}")
            else:
                self.foreign_faults += 1
        if ours:
            self._period(message, at_s)
        self._last[message.name] = (at_s, data)
        return message, signals

    def _faults(self, message, at_s, data):
        fault = end_to_end_fault(message, data)
        if fault is not None:
            yield fault
        elif data_id(message) is not None and message.name in self._last:
            expected = ((self._last[message.name][1][1] & 0x0F) + 1) % 15
            if data[1] & 0x0F != expected:
                yield f"counter {data[1] & 0x0F} instead of {expected}"

    def _period(self, message, at_s):
        cycle_s = float(attribute(message, "GenMsgCycleTime")) / 1000
        if message.name not in self._last or cycle_s == 0:
            return
        interval_s = at_s - self._last[message.name][0]
        low, high = self.intervals.get(message.name, (interval_s, interval_s))
        self.intervals[message.name] = (min(low, interval_s), max(high, interval_s))
        if abs(interval_s - cycle_s) > PERIOD_TOLERANCE_S:
            self.late.append(
                f"{at_s:.6f} s: {message.name} after {interval_s * 1000:.2f} ms instead of {cycle_s * 1000:.0f} ms"
            )

    def board_messages(self):
        """The messages that the board sends."""
        return [message.name for message in self.database.messages if BOARD in message.senders]

    def report(self, report):
        """The checks that hold for every traffic of a healthy board."""
        total = sum(self.frames.values()) + len(self.not_decoded)
        report.check_all("every frame is in the DBC and decoded", total, self.not_decoded)
        report.check_all("CRC, data ID and counter of the board's frames", total, self.faults)
        report.check_all("periods of the board's frames", total, self.late)
        missing = [name for name in self.board_messages() if name not in self.frames]
        report.check("every message of the board came", not missing, f"missing: {missing}" if missing else "")
        report.findings["frames"] = dict(sorted(self.frames.items()))
        report.findings["intervals_ms"] = {
            name: [round(low * 1000, 3), round(high * 1000, 3)]
            for name, (low, high) in sorted(self.intervals.items())
        }
        report.findings["faults_of_other_nodes"] = self.foreign_faults
