"""The register map as docs/modbus.md and docs/configuration.md print it, for clients that have nothing else."""

import re
from dataclasses import dataclass

from report import BadInput

WIDTHS = {"u16": 1, "i16": 1, "u32": 2, "i32": 2, "i64": 4}


@dataclass(frozen=True)
class Row:
    """A row of one of the tables: `count` values of one type, one behind the other."""

    address: int
    kind: str
    count: int
    name: str
    unit: str
    writable: str

    @property
    def width(self):
        """Registers of one value."""
        return WIDTHS[self.kind]

    @property
    def end(self):
        """The first address behind it."""
        return self.address + self.width * self.count

    @property
    def limits(self):
        """What the type can hold."""
        bits = 16 * self.width
        return (0, 2**bits - 1) if self.kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)

    def values(self, registers):
        """The values in its registers, most significant word first."""
        values = []
        for at in range(0, len(registers), self.width):
            raw = b"".join(word.to_bytes(2, "big") for word in registers[at : at + self.width])
            values.append(int.from_bytes(raw, "big", signed=self.kind.startswith("i")))
        return values

    def registers(self, values):
        """The registers that hold `values`."""
        words = []
        for value in values:
            raw = value.to_bytes(2 * self.width, "big", signed=self.kind.startswith("i"))
            words += [int.from_bytes(raw[at : at + 2], "big") for at in range(0, len(raw), 2)]
        return words


@dataclass(frozen=True)
class Map:
    """Both tables, the commands, the limits of each setting by its address, and the version."""

    version: int
    inputs: list
    holdings: list
    commands: dict
    limits: dict

    def input(self, name):
        """The input row of this name."""
        return named(self.inputs, name)

    def holding(self, name):
        """The holding row of this name."""
        return named(self.holdings, name)


def named(rows, name):
    """The only row of this name."""
    found = [row for row in rows if row.name == name]
    if len(found) != 1:
        raise BadInput(f"the map has {len(found)} registers called {name!r}")
    return found[0]


def section(text, name, path):
    """The cells of a generated table."""
    match = re.search(rf"<!-- {name}: from the code -->(.*?)<!-- {name}: end -->", text, re.DOTALL)
    if match is None:
        raise BadInput(f"{path}: no table {name!r}")
    lines = [line for line in match[1].splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def row(cells, writable, path):
    """A row from its cells."""
    address = re.fullmatch(r"0x([0-9A-F]{4})(?: … 0x([0-9A-F]{4}))?", cells[0])
    kind = re.fullmatch(r"(\w+)(?: × (\d+))?", cells[1])
    if address is None or kind is None or kind[1] not in WIDTHS:
        raise BadInput(f"{path}: cannot read the row {cells}")
    found = Row(int(address[1], 16), kind[1], int(kind[2] or 1), cells[2], cells[3], writable)
    if found.end - 1 != int(address[2] or address[1], 16):
        raise BadInput(f"{path}: address and type of {found.name!r} contradict each other")
    return found


def number(text):
    """A number as the documents write it."""
    return int(text.replace("−", "-").replace(",", ""))


def read(path):
    """A document."""
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError as error:
        raise BadInput(str(error)) from error


def load(map_path, configuration_path):
    """The map from both documents."""
    text = read(map_path)
    version = re.search(r"Map version (\d+)\.(\d+)\.", text)
    if version is None:
        raise BadInput(f"{map_path}: no map version")
    limits = {}
    for cells in section(read(configuration_path), "settings", configuration_path):
        if len(cells) == 6 and cells[5].startswith("0x"):
            limits[int(cells[5], 16)] = (number(cells[2]), number(cells[3]))
    return Map(
        version=int(version[1]) * 256 + int(version[2]),
        inputs=[row(cells, "", map_path) for cells in section(text, "input registers", map_path)],
        holdings=[row(cells, cells[4], map_path) for cells in section(text, "holding registers", map_path)],
        commands={cells[1]: int(cells[0], 16) for cells in section(text, "commands", map_path)},
        limits=limits,
    )
