"""Reads and validates YAML files of deployments: one path per line of stdin, one line of JSON per path.

The line contains the documents and their schema errors. Files named compose* use the schema of Compose, others that of
Kubernetes for each known kind of document. Kustomize files have no schema and are only parsed.
"""

import importlib.resources
import json
import pathlib
import sys

# jsonschema would spend seconds on the grammars of a format that is not checked here.
sys.modules["rfc3987_syntax"] = None

import jsonschema
import kubernetes_validate
import yaml

KUBERNETES = "1.37"
KUSTOMIZE = "kustomize.config.k8s.io/"


def compose_schema():
    schemas = importlib.resources.files("check_jsonschema") / "builtin_schemas" / "vendor" / "compose-spec.json"
    schema = json.loads(schemas.read_text())
    return jsonschema.validators.validator_for(schema)(schema)


def against_compose(document):
    return [f"{error.json_path}: {error.message}" for error in compose_schema().iter_errors(document)]


def against_kubernetes(document):
    if str(document.get("apiVersion", "")).startswith(KUSTOMIZE):
        return []
    try:
        kubernetes_validate.validate(document, KUBERNETES, strict=True)
    except kubernetes_validate.SchemaNotFoundError:
        return [f"no such kind: {document.get('apiVersion')} {document.get('kind')}"]
    except kubernetes_validate.ValidationError as error:
        return [str(error).splitlines()[0]]
    return []


def check_file(path):
    try:
        documents = [d for d in yaml.safe_load_all(path.read_text()) if d is not None]
    except yaml.YAMLError as error:
        return {"documents": [], "errors": [f"not YAML: {error}"]}
    check = against_compose if path.name.startswith("compose") else against_kubernetes
    return {"documents": documents, "errors": [error for document in documents for error in check(document)]}


for line in sys.stdin:
    print(json.dumps(check_file(pathlib.Path(line.strip()))), flush=True)
