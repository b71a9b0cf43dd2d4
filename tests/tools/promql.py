"""Extracts and parses the PromQL of dashboards and rules.

Reads paths from standard input, one per line; writes one line of JSON per path. A `.json` file is a dashboard of
Grafana, a `.yaml` file rules of Prometheus.
"""

import json
import re
import sys

import promql_parser as promql
import yaml

# Replacements for Grafana's variables.
VARIABLES = {"$__rate_interval": "5m", "$__interval": "1m", "$__range": "1h", "$job": "x", "$instance": "x"}


def of_dashboard(document):
    """Yields title, expression and related texts of panels, annotations and variables."""
    for panel in document["panels"]:
        for target in panel.get("targets", []):
            yield f"panel {panel['title']}", target["expr"], target["legendFormat"]
    for annotation in document.get("annotations", {}).get("list", []):
        if "expr" in annotation:
            yield f"annotation {annotation['name']}", annotation["expr"], ""
    for variable in document.get("templating", {}).get("list", []):
        found = re.fullmatch(r"label_values\((.+), *([a-z_]+)\)", variable.get("query", ""))
        if variable["type"] == "query":
            if not found:
                raise ValueError(f"variable {variable['name']}: {variable['query']}")
            yield f"variable {variable['name']}", f"count by ({found[2]}) ({found[1]})", ""


def of_rules(document):
    for group in document["groups"]:
        for rule in group["rules"]:
            yield rule.get("alert") or rule["record"], rule["expr"], json.dumps(rule.get("annotations", {}))


def children(node):
    for name in ("expr", "lhs", "rhs", "vector_selector"):
        child = getattr(node, name, None)
        if child is not None:
            yield child
    yield from getattr(node, "args", None) or []


def selectors(node):
    """Returns the selectors below a node: name, matchers, and labels used by the enclosing expressions."""
    if isinstance(node, promql.VectorSelector):
        matchers = node.matchers.matchers
        yield {
            "metric": node.name or next((m.value for m in matchers if m.name == "__name__"), None),
            "matchers": [[m.name, m.value, "Re" in str(m.op)] for m in matchers if m.name != "__name__"],
            "around": [],
        }
        return
    around = []
    modifier = getattr(node, "modifier", None)
    # `by`, `without`, `on`, `ignoring` and `group_left` use labels.
    for part in (modifier, getattr(modifier, "matching", None)):
        around += getattr(part, "labels", None) or []
    around += getattr(modifier, "group_labels", None) or []
    for child in children(node):
        for selector in selectors(child):
            selector["around"] += around
            yield selector


def expression(place, text, words):
    # `{{route}}` in a legend, `{{ $labels.route }}` in an annotation.
    shown = re.findall(r"\{\{ *(?:\$labels\.)?([a-z_]+) *\}\}", words)
    for name, value in VARIABLES.items():
        text = text.replace(name, value)
    if "$" in text:
        return {"place": place, "error": f"unknown variable: {text}", "selectors": []}
    try:
        found = list(selectors(promql.parse(text)))
        for selector in found:
            selector["around"] += shown
        return {"place": place, "error": None, "selectors": found}
    except ValueError as error:
        return {"place": place, "error": f"{error}: {text}", "selectors": []}


def report(path):
    try:
        with open(path, encoding="utf-8") as file:
            found = of_dashboard(json.load(file)) if path.endswith(".json") else of_rules(yaml.safe_load(file))
            return {"error": None, "expressions": [expression(*each) for each in found]}
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        return {"error": repr(error), "expressions": []}


for line in sys.stdin:
    print(json.dumps(report(line.rstrip("\n"))), flush=True)
