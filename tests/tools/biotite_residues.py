"""Prints chains, residues and atom counts that biotite reads, as an independent check of tests/core/structure_real.rs.

Reads file names from standard input, and prints one line of JSON for each: the numbers of atoms of all models, and the
residues of the first model, sorted: chain, number with insertion code, name, and number of atoms with all alternative
locations. The line is a text with the error for a file that biotite rejects.
"""

import collections
import gzip
import json
import sys
import warnings

from biotite.structure.io import pdb, pdbx


def read(path):
    # Elements that biotite guesses are not compared.
    warnings.simplefilter("ignore")
    is_cif = ".cif" in path
    opener = gzip.open if path.endswith(".gz") else open
    with opener(path, "rt", encoding="latin-1") as text:
        file = pdbx.CIFFile.read(text) if is_cif else pdb.PDBFile.read(text)
    count = pdbx.get_model_count if is_cif else pdb.get_model_count
    module = pdbx if is_cif else pdb
    models = [
        module.get_structure(file, model=model + 1, altloc="all", **({"use_author_fields": True} if is_cif else {}))
        for model in range(count(file))
    ]
    first = models[0]
    residues = collections.Counter(
        zip(
            first.chain_id.tolist(),
            (f"{number}{code}" for number, code in zip(first.res_id.tolist(), first.ins_code.tolist(), strict=True)),
            first.res_name.tolist(),
            strict=True,
        )
    )
    return {
        "models": [model.array_length() for model in models],
        "residues": sorted([*residue, n] for residue, n in residues.items()),
    }


def main():
    for line in sys.stdin:
        try:
            print(json.dumps(read(line.strip())), flush=True)
        except Exception as error:  # noqa: BLE001 (the test names files that biotite rejects)
            print(json.dumps(f"{type(error).__name__}: {error}"), flush=True)


main()
