"""Van der Waals radii of molmesh for the elements of prepared structures, Å, for peers that accept radii."""

RADII = {"H": 1.10, "C": 1.70, "N": 1.55, "O": 1.52, "P": 1.80, "S": 1.80, "SE": 1.90}
