"""Reads names of PDB files from standard input. Prints the residues of the first model of each by Biopython, as JSON in
a line: chain, number, insertion code, name and number of distinct atoms. tests/core/structure_cases.rs compares them.
"""

import gzip
import json
import sys
import warnings

from Bio.PDB import PDBParser


def residues(path):
    opener = gzip.open if path.endswith(".gz") else open
    with opener(path, "rt") as file:
        structure = PDBParser(QUIET=True).get_structure("x", file)
    for residue in structure[0].get_residues():
        _, number, code = residue.id
        yield [residue.get_parent().id.strip(), number, code.strip(), residue.get_resname().strip(), len(residue)]


warnings.simplefilter("ignore")
for line in sys.stdin:
    print(json.dumps(list(residues(line.rstrip("\n")))))
