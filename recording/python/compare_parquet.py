"""Compares a Parquet file that we wrote with the CSV that we wrote of the same columns, as pyarrow and Python read them.

    compare_parquet.py OURS.parquet OURS.csv

Exit code 0: the same numbers, bit by bit, 1: a difference, 2: bad input.
"""

import csv
import math
import struct
import sys

import pyarrow.parquet


def bits(text):
    return None if text == "" else struct.pack("<d", float(text))


def main():
    if len(sys.argv) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    table = pyarrow.parquet.read_table(sys.argv[1])
    with open(sys.argv[2], newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    header, rows = rows[0], rows[1:]
    if table.column_names != header or table.num_rows != len(rows):
        print(f"{table.num_rows} rows of {table.column_names} instead of {len(rows)} of {header}")
        return 1
    for column, name in enumerate(header):
        values = table.column(name).to_pylist()
        for row, (ours, text) in enumerate(zip(values, rows)):
            packed = None if ours is None else struct.pack("<d", ours)
            if packed != bits(text[column]) or ours is not None and not math.isfinite(ours):
                print(f"row {row}, {name}: {ours} instead of {text[column]}")
                return 1
    print(f"{table.num_rows} rows of {len(header)} columns are the same")
    return 0


if __name__ == "__main__":
    sys.exit(main())
