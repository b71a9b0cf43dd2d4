"""Finds the residues that line each pocket of a structure that gemmi reads, and meshes the largest pocket.

Needs: the packages molmesh and gemmi
"""

import sys

import gemmi
import numpy as np

import molmesh

structure = gemmi.read_structure(*sys.argv[1:] or ["samples/4pti.pdb"])
structure.remove_ligands_and_waters()
structure.remove_alternative_conformations()
rows = [cra for cra in structure[0].all() if not cra.atom.is_hydrogen()]
coordinates = np.array([cra.atom.pos.tolist() for cra in rows])
radii = np.array([cra.atom.element.vdw_r for cra in rows])

pockets = molmesh.pockets(coordinates, radii)
for pocket in pockets[:3]:
    residues = sorted({(rows[i].chain.name, rows[i].residue.seqid.num, rows[i].residue.name) for i in pocket.atoms})
    names = " ".join(f"{chain}/{name}{number}" for chain, number, name in residues)
    print(f"{pocket.volume:.0f} Å³, {pocket.openings} openings: {names}")

# One part of the surface for each pocket, in the same order, and one for the rest.
mesh = molmesh.surface(coordinates, radii, surface="ses", split="pocket", resolution=0.7)
parts = mesh.report["parts"]
faces = np.split(mesh.faces, np.cumsum([part["triangles"] for part in parts])[:-1])
assert [len(part) for part in faces[:-1]] == [part["triangles"] for part in parts if part["name"] != "other"]
assert len(parts) == len(pockets) + 1 and pockets[0].volume >= pockets[-1].volume >= 5
corners = mesh.vertices[faces[0]].reshape(-1, 3)
assert np.linalg.norm(corners.mean(axis=0) - pockets[0].center) < 10
