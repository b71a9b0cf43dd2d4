"""Prints the secondary structure that gemmi reads, as an independent check of tests/core/structure_real.rs.

Reads file names from standard input, and prints one line of JSON for each:
the residues of the first model, in file order,
as chain, number with insertion code, and `H` (helix), `E` (strand) or `-`. The line is `null` for a file that gemmi
rejects.
"""

import json
import sys

import gemmi


def read(path):
    try:
        structure = gemmi.read_structure(path)
    except RuntimeError:
        return None
    ranges = [(helix.start, helix.end, "H") for helix in structure.helices]
    ranges += [(s.start, s.end, "E") for sheet in structure.sheets for s in sheet.strands]
    found = []
    for chain in structure[0]:
        for residue in chain:
            key = (residue.seqid.num, residue.seqid.icode)
            within = [
                (first.res_id.seqid.num, first.res_id.seqid.icode, kind)
                for first, last, kind in ranges
                if first.chain_name == chain.name
                and (first.res_id.seqid.num, first.res_id.seqid.icode) <= key
                and key <= (last.res_id.seqid.num, last.res_id.seqid.icode)
            ]
            # Of ranges that overlap, the product takes the one that begins first.
            within.sort(key=lambda r: r[:2])
            found.append([chain.name, str(residue.seqid).strip(), within[0][2] if within else "-"])
    return found


for line in sys.stdin:
    print(json.dumps(read(line.strip())), flush=True)
