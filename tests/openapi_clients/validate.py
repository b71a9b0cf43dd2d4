"""Validates an OpenAPI document, for tests/http/openapi.rs.

Usage: validate.py DOCUMENT.json DOCUMENT.yaml. Checks the document against the specification, every example of a schema
against that schema, and that a YAML 1.1 parser reads the same document from both files. Exits with 1 and a message on
standard error if a check fails.
"""

import json
import sys

# jsonschema would spend seconds on the grammars of a format that is not checked here.
sys.modules["rfc3987_syntax"] = None

import yaml
from jsonschema import Draft202012Validator
from openapi_spec_validator import validate


def check_examples(name, schema, root):
    """Validates the examples of a schema and of the schemas in it."""
    if not isinstance(schema, dict):
        return
    for example in [*schema.get("examples", []), *([schema["example"]] if "example" in schema else [])]:
        # References are resolved from the root, which has the components beside the schema's own keywords.
        for error in Draft202012Validator({**schema, "components": root["components"]}).iter_errors(example):
            sys.exit(f"the example of {name} is not valid: {error.message}")
    for member, part in schema.get("properties", {}).items():
        check_examples(f"{name}.{member}", part, root)


with open(sys.argv[1], encoding="utf-8") as file:
    document = json.load(file)
with open(sys.argv[2], encoding="utf-8") as file:
    from_yaml = yaml.load(file, yaml.CSafeLoader)
validate(document)
for name, schema in document["components"]["schemas"].items():
    check_examples(name, schema, document)
for name, parameter in document["components"]["parameters"].items():
    check_examples(name, parameter["schema"], document)
if from_yaml != document:
    sys.exit("YAML 1.1 and JSON differ")
