"""Computes solvent-accessible areas with FreeSASA: one path per line of stdin, one line of JSON per path.

A file has one sphere per line: x, y, z and the van der Waals radius in Å. The probe radius is 1.4 Å.
"""

import json
import sys

import freesasa

freesasa.setVerbosity(freesasa.nowarnings)
parameters = freesasa.Parameters({"algorithm": freesasa.LeeRichards, "n-slices": 1000, "probe-radius": 1.4})
for path in sys.stdin.read().splitlines():
    with open(path, encoding="utf-8") as file:
        rows = [[float(word) for word in line.split()] for line in file]
    coordinates = [value for row in rows for value in row[:3]]
    result = freesasa.calcCoord(coordinates, [row[3] for row in rows], parameters)
    areas = [result.atomArea(i) for i in range(len(rows))]
    print(json.dumps({"area": result.totalArea(), "of_spheres": areas}))
