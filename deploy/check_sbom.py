"""Holds bills of materials against CycloneDX's schema, as another project checks it, and against cargo's own list of what is
linked; a spoiled copy of each must be refused. Usage: python deploy/check_sbom.py FILE.cdx.json ... (in the tests' environment)
"""

import json
import pathlib
import subprocess
import sys

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

ROOT = pathlib.Path(__file__).resolve().parent.parent
VALIDATOR = JsonStrictValidator(SchemaVersion.V1_5)
# What the pages hold that others wrote.
PAGES = ("swagger-ui-dist", "three", "meshoptimizer")


def linked():
    """`name version` of every crate that cargo links into the binary, build scripts and macros aside."""
    command = ["cargo", "tree", "--locked", "--edges", "normal", "--prefix", "none", "--format", "{p}"]
    lines = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    words = [line.split() for line in lines if line]
    return {f"{name} {version.removeprefix('v')}" for name, version, *_ in words if name != "molmesh"}


def faults(text, crates):
    """What is wrong with a document."""
    error = VALIDATOR.validate_str(text)
    if error is not None:
        return [f"against the schema: {str(error)[:300]}"]
    bom = json.loads(text)
    parts = [bom["metadata"]["component"], *bom["components"]]
    named = {f"{part['name']} {part.get('version')}" for part in parts}
    refs = [part["bom-ref"] for part in parts]
    wrong = [f"lacks the crate {crate}" for crate in sorted(crates - named)]
    wrong += [f"{ref} comes twice" for ref in sorted(set(refs)) if refs.count(ref) > 1]
    pointed = {ref for edge in bom["dependencies"] for ref in (edge["ref"], *edge.get("dependsOn", []))}
    wrong += [f"{ref} is nothing" for ref in sorted(pointed - set(refs))]
    wrong += [f"names this machine: {ref}" for ref in refs if "/" + "root" in ref or str(ROOT) in ref]
    wrong += [f"lacks {name}, which is in the pages" for name in PAGES if not any(part["name"] == name for part in parts)]
    crated = [part for part in parts if part["bom-ref"].startswith("crates/")]
    wrong += [f"{part['name']} has no licence or digest" for part in crated if not (part.get("licenses") and part.get("hashes"))]
    return wrong


def spoiled(text):
    """Copies with one fault each."""
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
            sys.exit(f"{path}: spoiled copies {let_through} were let through")
        print(f"{path}: CycloneDX 1.5, {len(json.loads(text)['components'])} components")


if __name__ == "__main__":
    main()
