#!/usr/bin/env python3
"""Draws the gallery: docs/gallery/*.png and the table of docs/research/gallery.md.

    docs/gallery/make.py --data FOLDER [--binary target/release/molmesh] [--only 4PTI]

FOLDER contains structures named by their PDB ids, in any format and compression that molmesh reads. The script names
missing structures and keeps their pictures. `--more` also draws, into build/gallery, the entries of the 2010 paper that
are not in the gallery. The CPU draws all pictures, so they do not depend on a graphics driver.
"""

import argparse
import json
import pathlib
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PAGE = HERE.parent / "research" / "gallery.md"
BEGIN, END = "<!-- pictures: docs/gallery/make.py writes from here -->\n", "<!-- to here -->\n"
KERNELS = ["gaussian", "soft-object", "inverse-square"]
VIEW = ["--width", "320", "--height", "240", "--background", "white"]
# PDB id, description, and further flags of its mesh.
SHOWN = [
    ("4PTI", "trypsin inhibitor; an entry of the paper", []),
    ("2HHB", "deoxyhaemoglobin; replaces the paper's 1BIJ, another haemoglobin", []),
    ("1A0Q", "a Fab fragment, the antibody 29G11", []),
    ("7CTH", "dengue virus serotype 2 with fragments of the antibody EDE1 C10", ["--detail", "4"]),
    ("6ZU5", "a microsporidian ribosome", ["--detail", "4"]),
]
MORE = [("110D", "", []), ("1BK2", "", []), ("1QL2", "", []), ("1AON", "", ["--detail", "4"]), ("7CGO", "", ["--detail", "4"])]


def structure(folder, pdb_id):
    """Returns the file of an entry: the bundled one, or one of the folder; None if there is none."""
    bundled = ROOT / "samples" / f"{pdb_id.lower()}.pdb"
    if bundled.exists():
        return bundled
    if folder is None:
        return None
    found = sorted(path for path in folder.iterdir() if path.name.lower().split(".")[0] == pdb_id.lower())
    return found[0] if found else None


def draw(binary, path, flags, out):
    """Draws one picture and returns its report."""
    command = [binary, "render", path, "-o", out, *flags, "--backend", "cpu", "--report", "json", "--quiet"]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{out.name}: {done.stderr.strip()}")
    return json.loads(done.stdout)


def rows(binary, folder, entries, out, only):
    """Draws the entries whose structures exist. Yields id, description and the pictures with flags and report."""
    out.mkdir(parents=True, exist_ok=True)
    for pdb_id, about, more in entries:
        path = structure(folder, pdb_id)
        if path is None or (only and pdb_id != only.upper()):
            print(f"{pdb_id}: " + ("skipped" if path else "no structure"))
            continue
        reports = []
        for kernel in KERNELS:
            flags = [*VIEW, "--surface", kernel, *more]
            picture = out / f"{pdb_id.lower()}-{kernel}.png"
            reports.append((kernel, flags, picture, draw(binary, path, flags, picture)))
            print(f"{picture.name}: {picture.stat().st_size:,} bytes")
        yield pdb_id, about, reports


def section(pdb_id, about, reports):
    """Returns an entry of the page as Markdown."""
    atoms = reports[0][3]["atoms"]
    lines = [f"### {pdb_id}", "", f"{about[0].upper()}{about[1:]}. {atoms:,} atoms.", ""]
    lines += ["| " + " | ".join(kernel for kernel, *_ in reports) + " |", "|" + "---|" * len(reports)]
    lines.append("| " + " | ".join(f"![{pdb_id}, {kernel}](../gallery/{p.name})" for kernel, _, p, _ in reports) + " |")
    lines += ["", "| kernel | spacing Å | triangles | area Å² | volume Å³ | Å a pixel | command |", "|---|---|---|---|---|---|---|"]
    for kernel, flags, picture, report in reports:
        cells = [
            kernel,
            f"{report['resolution']:g}",
            f"{report['triangles']:,}",
            f"{report['area']:,.0f}",
            f"{report['volume']:,.0f}",
            f"{report['picture']['pixel']:.4f}",
            f"`molmesh render FILE -o {picture.name} {' '.join(flags)}`",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, help="folder of structures, named by their PDB ids")
    parser.add_argument("--binary", default=ROOT / "target" / "release" / "molmesh")
    parser.add_argument("--only", metavar="ID", help="one entry; the page is not changed")
    parser.add_argument("--more", action="store_true", help="the paper's other entries, into build/gallery")
    args = parser.parse_args()
    drawn = list(rows(args.binary, args.data, SHOWN, HERE, args.only))
    if args.more:
        list(rows(args.binary, args.data, MORE, ROOT / "build" / "gallery", args.only))
    if len(drawn) < len(SHOWN):
        print("docs/research/gallery.md was not changed: not every entry was drawn")
        return
    before, rest = PAGE.read_text().split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(before + BEGIN + "\n" + "".join(section(*entry) for entry in drawn) + END + after)


main()
