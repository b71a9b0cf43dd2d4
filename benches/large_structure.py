"""Writes a large made-up structure as mmCIF files: copies of a small one on a cubic lattice, each with one of 64 random
orientations. Each copy is a chain. The same arguments give the same bytes.

    python3 benches/large_structure.py samples/4pti.pdb cell --atoms 10000000 --files 1
    /usr/bin/time -v molmesh tileset cell-1.cif --scratch /tmp --resolution 8 --color chain -o cell-tiles
"""

import argparse
import math
import random

ITEMS = (
    "group_PDB type_symbol label_atom_id label_comp_id label_asym_id label_seq_id Cartn_x Cartn_y Cartn_z occupancy"
    " B_iso_or_equiv auth_asym_id"
).split()


def atoms_of(path):
    """Returns element, name, residue, number and position of the ATOM records of a PDB file, around their centre."""
    with open(path, encoding="ascii") as file:
        lines = [line for line in file if line.startswith("ATOM")]
    rows = []
    for line in lines:
        at = [float(line[start : start + 8]) for start in (30, 38, 46)]
        name = line[12:16].strip()
        rows.append((line[76:78].strip() or name[0], name, line[17:20].strip(), line[22:26].strip(), at))
    centre = [sum(row[4][k] for row in rows) / len(rows) for k in range(3)]
    return [(*row[:4], [row[4][k] - centre[k] for k in range(3)]) for row in rows]


def rotation(numbers):
    """Returns a random rotation matrix, from a unit quaternion."""
    q = [numbers.gauss(0, 1) for _ in range(4)]
    norm = math.sqrt(sum(c * c for c in q))
    w, x, y, z = (c / norm for c in q)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def chain_name(number):
    """Returns the name of a chain in base 36."""
    digits = ""
    while number or not digits:
        number, digit = divmod(number, 36)
        digits = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"[digit] + digits
    return digits


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("unit", help="PDB file of the small structure")
    parser.add_argument("output", help="prefix of the files, which get the names OUTPUT-NUMBER.cif")
    parser.add_argument("--atoms", type=int, default=10_000_000, help="minimum number of atoms")
    parser.add_argument("--files", type=int, default=1)
    parser.add_argument("--lattice", type=float, default=40.0, help="distance of the copies, Å")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    numbers = random.Random(args.seed)
    unit = atoms_of(args.unit)
    turned = []
    for _ in range(64):
        m = rotation(numbers)
        turned.append([[sum(m[k][i] * row[4][i] for i in range(3)) for k in range(3)] for row in unit])
    heads = [f"ATOM {element} {name} {residue} " for element, name, residue, *_ in unit]
    sequence = [row[3] for row in unit]
    copies = -(-args.atoms // len(unit))
    along = math.ceil(copies ** (1 / 3))
    for number in range(args.files):
        with open(f"{args.output}-{number + 1}.cif", "w", encoding="ascii") as file:
            file.write("data_CELL\n#\nloop_\n" + "".join(f"_atom_site.{item}\n" for item in ITEMS))
            for copy in range(copies * number // args.files, copies * (number + 1) // args.files):
                chain = chain_name(copy)
                at = (copy // along**2, copy // along % along, copy % along)
                x, y, z = ((c - along / 2) * args.lattice for c in at)
                rows = zip(heads, sequence, turned[numbers.randrange(64)])
                file.writelines(
                    f"{head}{chain} {seq} {x + a:.3f} {y + b:.3f} {z + c:.3f} 1.00 20.00 {chain}\n"
                    for head, seq, (a, b, c) in rows
                )
            file.write("#\n")
    print(f"{copies * len(unit)} atoms in {args.files} files")


if __name__ == "__main__":
    main()
