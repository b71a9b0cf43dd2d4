"""Adds valid structures to the requests of Schemathesis, so that some pass the reader. Random bytes, which the schema
permits, are sent as well."""

import gzip
import urllib.parse

import schemathesis
from hypothesis import strategies as st

ATOM = "ATOM  {n:5}  CA  {residue} {chain}{n:4}    {x:8.3f}{y:8.3f}   0.000  1.00  0.00           C  \n"
PDB = "".join(
    ATOM.format(n=n, residue="ALA", chain="AB"[n % 2], x=3.0 * n, y=n % 2) for n in range(1, 6)
).encode()
CIF = b"""data_X
loop_
_atom_site.group_PDB
_atom_site.id
_atom_site.type_symbol
_atom_site.label_atom_id
_atom_site.label_comp_id
_atom_site.label_asym_id
_atom_site.label_seq_id
_atom_site.Cartn_x
_atom_site.Cartn_y
_atom_site.Cartn_z
ATOM 1 C CA ALA A 1 0.0 0.0 0.0
ATOM 2 C CA ALA A 2 3.0 0.0 0.0
"""

any_structure = st.one_of(st.sampled_from([PDB, CIF, gzip.compress(PDB, mtime=0)]), st.binary(max_size=200))
schemathesis.openapi.media_type("application/octet-stream", any_structure)
schemathesis.openapi.format("binary", any_structure)


@schemathesis.hook
def filter_query(context, query):
    """Drops queries that do not fit into a request line: the HTTP library rejects them with 414 or 431 and without a
    problem document, before the API sees them."""
    return query is None or len(urllib.parse.urlencode(query, doseq=True)) < 32_768
