"""Validates JSON Schemas and documents with jsonschema: one path per line of stdin, one line of JSON per path.

A file contains {"schema": …, "documents": [...]}. The output has the error of the schema (null if it is valid under
draft 2020-12) and the errors of each document.
"""

import json
import sys

# jsonschema would spend seconds on the grammars of a format that is not checked here.
sys.modules["rfc3987_syntax"] = None

from jsonschema import Draft202012Validator
from jsonschema.exceptions import SchemaError


def check(path):
    with open(path, encoding="utf-8") as file:
        case = json.load(file)
    schema = case["schema"]
    try:
        Draft202012Validator.check_schema(schema)
    except SchemaError as error:
        return {"schema": str(error.message), "documents": []}
    validator = Draft202012Validator(schema)
    errors = [[f"{e.json_path}: {e.message}" for e in validator.iter_errors(d)] for d in case["documents"]]
    return {"schema": None, "documents": errors}


for line in sys.stdin:
    print(json.dumps(check(line.rstrip("\n"))), flush=True)
