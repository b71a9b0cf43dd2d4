#!/usr/bin/env python3
"""Writes a bill of materials (CycloneDX 1.5, JSON) from cargo-cyclonedx's list of crates.

Without --root, it describes the binary: crates and third-party parts of the web pages. With --root, a file from `docker
export`, it describes an image: also Debian packages, installed or copied in part. The output depends only on the input:
references contain no local paths, and the serial number is a digest.

Usage: deploy/sbom.py CRATES.json [--root ROOT.tar --name molmesh:cpu] >OUT.cdx.json
"""

import argparse
import base64
import json
import pathlib
import re
import sys
import tarfile
import urllib.parse
import uuid

ROOT = pathlib.Path(__file__).resolve().parent.parent
APPLICATION = "molmesh"
# dpkg's list of installed packages; files below the second path describe packages that were copied in part.
STATUS = "var/lib/dpkg/status"
COPIED = "var/lib/dpkg/status.d/"


def crates(path):
    """Returns cargo-cyclonedx's document with references that do not depend on the machine."""
    bom = json.loads(pathlib.Path(path).read_text())
    own = bom["metadata"]["component"]
    at = own["bom-ref"]

    def ref(text):
        if text.startswith(at):
            return APPLICATION
        text = re.sub(r"^path\+[^#]*#", "workspace/", text)
        return re.sub(r"^registry\+[^#]*#", "crates/", text)

    application = {key: own[key] for key in ("type", "name", "version", "description", "licenses")}
    application |= {"bom-ref": APPLICATION, "purl": f"pkg:cargo/{own['name']}@{own['version']}"}
    bom["metadata"]["component"] = application
    for component in bom["components"]:
        component["bom-ref"] = ref(component["bom-ref"])
        # cargo-cyclonedx adds the folder.
        if component["bom-ref"].startswith("workspace/"):
            component["purl"] = f"pkg:cargo/{component['name']}@{component['version']}"
    for edge in bom["dependencies"]:
        edge["ref"] = ref(edge["ref"])
        edge["dependsOn"] = sorted({ref(text) for text in edge.get("dependsOn", [])})
    # CycloneDX 1.5 lists tools as components; the older form is deprecated.
    bom["metadata"]["tools"] = {
        "components": [
            {"type": "application", "group": tool.get("vendor", ""), "name": tool["name"], "version": tool["version"]}
            for tool in bom["metadata"]["tools"]
        ]
    }
    return bom


def swagger():
    """Returns the component Swagger UI of the page at /docs, as its README describes it."""
    text = (ROOT / "web/swagger/README.md").read_text()
    version = re.search(r"`swagger-ui-dist` (\S+) \(Apache-2\.0", text)[1]
    files = re.findall(r"^    ([0-9a-f]{64})  (\S+)$", text, re.MULTILINE)
    assert len(files) == 2, files
    ref = f"npm/swagger-ui-dist@{version}"
    return {
        "type": "library",
        "bom-ref": ref,
        "name": "swagger-ui-dist",
        "version": version,
        "scope": "required",
        "licenses": [{"expression": "Apache-2.0"}],
        "purl": f"pkg:npm/swagger-ui-dist@{version}",
        "components": [
            {"type": "file", "bom-ref": f"{ref}/{name}", "name": name, "hashes": [{"alg": "SHA-256", "content": digest}]}
            for digest, name in files
        ],
    }


def viewer():
    """Yields the third-party packages of the page at / from its lock file: three.js and the meshopt decoder."""
    lock = json.loads((ROOT / "web/package-lock.json").read_text())["packages"]
    for name in ("three", "meshoptimizer"):
        package = lock[f"node_modules/{name}"]
        algorithm, digest = package["integrity"].split("-", 1)
        assert algorithm == "sha512", algorithm
        yield {
            "type": "library",
            "bom-ref": f"npm/{name}@{package['version']}",
            "name": name,
            "version": package["version"],
            "scope": "required",
            "hashes": [{"alg": "SHA-512", "content": base64.b64decode(digest).hex()}],
            "licenses": [{"expression": package["license"]}],
            "purl": f"pkg:npm/{name}@{package['version']}",
        }


def packages(status, how):
    """Yields the Debian packages in a dpkg status file."""
    for paragraph in re.split(r"\n\n+", status.strip()):
        fields = dict(line.split(": ", 1) for line in paragraph.splitlines() if re.match(r"^[A-Za-z-]+: ", line))
        if how == "installed" and not fields.get("Status", "").endswith(" installed"):
            continue
        name, version, architecture = fields["Package"], fields["Version"], fields["Architecture"]
        quoted = urllib.parse.quote(version, safe="")
        yield {
            "type": "library",
            "bom-ref": f"deb/{name}@{version}",
            "name": name,
            "version": version,
            "purl": f"pkg:deb/debian/{name}@{quoted}?arch={architecture}",
            "properties": [{"name": "molmesh:package", "value": how}],
        }


def image(bom, root, name):
    """Turns the binary's document into that of an image."""
    found = []
    with tarfile.open(root) as archive:
        for member in archive:
            path = member.name.removeprefix("./")
            if path == STATUS or (path.startswith(COPIED) and member.isfile()):
                how = "installed" if path == STATUS else "parts of it"
                found += packages(archive.extractfile(member).read().decode(), how)
            if path == "usr/lib/os-release":
                release = dict(re.findall(r'^([A-Z_]+)="?([^"\n]*)"?$', archive.extractfile(member).read().decode(), re.MULTILINE))
    if len(found) < 20:
        sys.exit(f"only {len(found)} packages in {root}: expected the root of an image")
    found.sort(key=lambda component: component["bom-ref"])
    application = bom["metadata"]["component"]
    system = {"type": "operating-system", "bom-ref": "debian", "name": release["ID"], "version": release["VERSION_ID"]}
    container = {"type": "container", "bom-ref": "image", "name": name, "version": application["version"]}
    bom["metadata"]["component"] = container
    bom["components"] = [application, system, *found, *bom["components"]]
    bom["dependencies"].append({"ref": "image", "dependsOn": [APPLICATION, "debian"]})
    bom["dependencies"].append({"ref": "debian", "dependsOn": [component["bom-ref"] for component in found]})


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("crates")
    parser.add_argument("--root")
    parser.add_argument("--name", default=APPLICATION)
    arguments = parser.parse_args()
    bom = crates(arguments.crates)
    for web in (swagger(), *viewer()):
        bom["components"].append(web)
        next(edge for edge in bom["dependencies"] if edge["ref"] == APPLICATION)["dependsOn"].append(web["bom-ref"])
        bom["dependencies"].append({"ref": web["bom-ref"], "dependsOn": []})
    if arguments.root:
        image(bom, arguments.root, arguments.name)
    bom.pop("serialNumber", None)
    digest = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(bom, sort_keys=True))
    bom = {"bomFormat": bom.pop("bomFormat"), "specVersion": bom.pop("specVersion"), "serialNumber": f"urn:uuid:{digest}"} | bom
    json.dump(bom, sys.stdout, indent=2, ensure_ascii=False)
    print()


if __name__ == "__main__":
    main()
