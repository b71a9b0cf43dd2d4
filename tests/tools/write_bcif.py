"""Writes the atoms of an mmCIF file as BinaryCIF with biotite, for tests/core/bcif_oracles.rs and benches/read.rs.

Usage: write_bcif.py VARIANT INPUT.cif[.gz] OUTPUT.bcif. Variants:

* plain: only ByteArray and StringArray, 64-bit real numbers
* single: the same with 32-bit real numbers
* packed: FixedPoint, Delta and two-byte IntegerPacking; texts with RunLength
* bytes: FixedPoint, RunLength and one-byte IntegerPacking with continued values; texts with Delta
* quantized: coordinates with IntervalQuantization in 10^6 steps
* texts: every column a StringArray, numbers too
* compressed: the encodings that biotite finds smallest

The categories in CATEGORIES are written. For every file one line of JSON: {"atoms": N, "encodings": [names]}.
Without arguments, lines of VARIANT, INPUT and OUTPUT separated by tabs are read from standard input.
"""

import gzip
import io
import json
import sys

import biotite.structure.io.pdbx as pdbx
import numpy as np

CATEGORIES = (
    "entry",
    "struct",
    "entity",
    "entity_poly",
    "struct_asym",
    "pdbx_struct_assembly_gen",
    "pdbx_struct_oper_list",
    "struct_conf",
    "struct_sheet_range",
    "atom_site",
)
BYTE_ARRAY = pdbx.ByteArrayEncoding
PLACES = {"Cartn_x": 3, "Cartn_y": 3, "Cartn_z": 3, "occupancy": 2, "B_iso_or_equiv": 2}
WHOLE = {"id", "auth_seq_id", "label_seq_id", "pdbx_PDB_model_num"}
STEPS = 10**6 + 1


def runs(size):
    return [pdbx.RunLengthEncoding(), pdbx.IntegerPackingEncoding(byte_count=size), BYTE_ARRAY()]


def differences(size):
    return [pdbx.DeltaEncoding(), pdbx.IntegerPackingEncoding(byte_count=size), BYTE_ARRAY()]


def chain(variant, name, values):
    """Returns the encodings of a column of numbers."""
    if name in PLACES:
        fixed = pdbx.FixedPointEncoding(10 ** PLACES[name])
        if variant == "plain":
            return [BYTE_ARRAY(pdbx.TypeCode.FLOAT64)]
        if variant == "single":
            return [BYTE_ARRAY(pdbx.TypeCode.FLOAT32)]
        if variant == "packed":
            return [fixed, *differences(2)]
        if variant == "quantized" and name.startswith("Cartn_"):
            interval = pdbx.IntervalQuantizationEncoding(float(values.min()), float(values.max()), STEPS)
            return [interval, BYTE_ARRAY()]
        return [fixed, *runs(1)]
    if variant in ("plain", "single"):
        return [BYTE_ARRAY()]
    return differences(2) if variant == "packed" else runs(1)


def texts(variant, values):
    """Returns the encoding of a column of texts."""
    encodings = {
        "packed": (runs(2), differences(1)),
        "bytes": (differences(1), runs(1)),
        "quantized": (runs(1), differences(2)),
    }
    data, offsets = encodings.get(variant, ([BYTE_ARRAY()], [BYTE_ARRAY()]))
    return [pdbx.StringArrayEncoding(data_encoding=data, offset_encoding=offsets)]


def column(variant, category, name, source):
    values = source.as_array(str)
    mask = None
    if source.mask is not None:
        mask = np.asarray(source.mask.array, dtype=np.uint8)
    if variant == "texts" or category != "atom_site" or name not in PLACES and name not in WHOLE:
        if mask is not None:
            values = np.where(mask == 0, values, "")
        data = pdbx.BinaryCIFData(values, texts(variant, values))
    else:
        if mask is not None:
            values = np.where(mask == 0, values, "0")
        values = values.astype(np.float64 if name in PLACES else np.int32)
        data = pdbx.BinaryCIFData(values, chain(variant, name, values))
    if mask is not None:
        encoding = [BYTE_ARRAY()] if variant in ("plain", "single", "texts") else [pdbx.RunLengthEncoding(), BYTE_ARRAY()]
        mask = pdbx.BinaryCIFData(mask, encoding)
    return pdbx.BinaryCIFColumn(data, mask)


def names(encoded):
    """Returns the kinds of encodings in a serialized column or file."""
    if isinstance(encoded, dict):
        own = {encoded["kind"]} if "kind" in encoded else set()
        return own.union(*map(names, encoded.values()))
    return set().union(*map(names, encoded)) if isinstance(encoded, (list, tuple)) else set()


def write(variant, source, target):
    opener = gzip.open if source.endswith(".gz") else open
    with opener(source, "rt") as file:
        block = pdbx.CIFFile.read(io.StringIO(file.read())).block
    out = pdbx.BinaryCIFBlock()
    for name in CATEGORIES:
        if name in block:
            columns = {key: column(variant, name, key, value) for key, value in block[name].items()}
            out[name] = pdbx.BinaryCIFCategory(columns)
    file = pdbx.BinaryCIFFile({source.rsplit("/", 1)[-1].split(".")[0].upper(): out})
    if variant == "compressed":
        file = pdbx.compress(file)
    file.write(target)
    kinds = names(file.serialize())
    print(json.dumps({"atoms": block["atom_site"].row_count, "encodings": sorted(kinds)}), flush=True)


if len(sys.argv) == 4:
    write(*sys.argv[1:])
else:
    for line in sys.stdin:
        write(*line.rstrip("\n").split("\t"))
