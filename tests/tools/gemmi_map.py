"""Prints values of a CCP4 map that gemmi interpolates linearly. tests/core/maps.rs compares them.

Usage: gemmi_map.py FILE X,Y,Z … One line per position in Å.
"""

import sys

import gemmi


def main():
    path, *positions = sys.argv[1:]
    ccp4 = gemmi.read_ccp4_map(path)
    ccp4.setup(float("nan"))
    for position in positions:
        x, y, z = map(float, position.split(","))
        print(repr(float(ccp4.grid.interpolate_value(gemmi.Position(x, y, z)))))


main()
