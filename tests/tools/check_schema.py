"""Validates JSON Schemas and documents with jsonschema: one path per line of stdin, one line of JSON per path.

A file holds {"schema": …, "documents": [...]}. The answer says why the schema is no schema of draft 2020-12 (null if it is
one), and for each document what the schema has against it.
"""

import json
import sys

from jsonschema import Draft202012Validator
from jsonschema.exceptions import SchemaError


def judge(path):
    with open(path, encoding="utf-8") as file:
        case = json.load(file)
    schema = case["schema"]
    try:
        Draft202012Validator.check_schema(schema)
    except SchemaError as error:
        return {"schema": str(error.message), "documents": []}
    validator = Draft202012Validator(schema)
    said = [[f"{e.json_path}: {e.message}" for e in validator.iter_errors(d)] for d in case["documents"]]
    return {"schema": None, "documents": said}


for line in sys.stdin:
    print(json.dumps(judge(line.rstrip("\n"))), flush=True)
