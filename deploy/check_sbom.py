"""Checks bills of materials against the CycloneDX schema and against cargo's list of linked crates. Invalid copies of
each document must be rejected. Usage: python deploy/check_sbom.py FILE.cdx.json ... (in the Python environment of the
tests)
"""

import json
import pathlib
import subprocess
import sys

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

ROOT = pathlib.Path(__file__).resolve().parent.parent
VALIDATOR = JsonStrictValidator(SchemaVersion.V1_5)
# Third-party packages bundled in the web pages.
PAGES = ("swagger-ui-dist", "three", "meshoptimizer")


def linked():
    """Returns `name version` of every crate that cargo links into the binary, without build dependencies."""
    command = ["cargo", "tree", "--locked", "--edges", "normal", "--prefix", "none", "--format", "{p}"]
    lines = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    words = [line.split() for line in lines if line]
    return {f"{name} {version.removeprefix('v')}" for name, version, *_ in words if name != "molmesh"}


def faults(text, crates):
    """Returns the faults of a document."""
    error = VALIDATOR.validate_str(text)
    if error is not None:
        return [f"against the schema: {str(error)[:300]}"]
    bom = json.loads(text)
    parts = [bom["metadata"]["component"], *bom["components"]]
    named = {f"{part['name']} {part.get('version')}" for part in parts}
    refs = [part["bom-ref"] for part in parts]
    wrong = [f"lacks the crate {crate}" for crate in sorted(crates - named)]
    wrong += [f"{ref} occurs twice" for ref in sorted(set(refs)) if refs.count(ref) > 1]
    pointed = {ref for edge in bom["dependencies"] for ref in (edge["ref"], *edge.get("dependsOn", []))}
    wrong += [f"{ref} is not defined" for ref in sorted(pointed - set(refs))]
    wrong += [f"contains a path of this machine: {ref}" for ref in refs if "/" + "root" in ref or str(ROOT) in ref]
    wrong += [f"lacks {name}, which the web pages contain" for name in PAGES if not any(part["name"] == name for part in parts)]
    crated = [part for part in parts if part["bom-ref"].startswith("crates/")]
    wrong += [f"{part['name']} has no licence or digest" for part in crated if not (part.get("licenses") and part.get("hashes"))]
    return wrong


def spoiled(text):
    """Yields copies with one fault each."""
    for change in (
        lambda bom: bom["components"][0].update(type="librarie"),
        lambda bom: bom.pop("bomFormat"),
        lambda bom: bom["components"].remove(next(c for c in bom["components"] if c["name"] == "tokio")),
        lambda bom: bom["components"].remove(next(c for c in bom["components"] if c["name"] == "swagger-ui-dist")),
        lambda bom: bom["components"].remove(next(c for c in bom["components"] if c["name"] == "three")),
        lambda bom: bom["dependencies"].append({"ref": "nobody"}),
        lambda bom: next(c for c in bom["components"] if c["bom-ref"].startswith("crates/")).pop("hashes"),
    ):
        bom = json.loads(text)
        change(bom)
        yield json.dumps(bom)


def main():
    crates = linked()
    if len(crates) < 100 or not sys.argv[1:]:
        sys.exit(f"{len(crates)} crates, {len(sys.argv) - 1} files: nothing to compare")
    for path in sys.argv[1:]:
        text = pathlib.Path(path).read_text()
        if wrong := faults(text, crates):
            sys.exit(f"{path}: " + "; ".join(wrong[:20]))
        let_through = [i for i, copy in enumerate(spoiled(text)) if not faults(copy, crates)]
        if let_through:
            sys.exit(f"{path}: invalid copies {let_through} were accepted")
        print(f"{path}: CycloneDX 1.5, {len(json.loads(text)['components'])} components")


if __name__ == "__main__":
    main()
