#!/usr/bin/env python3
"""Writes the licences of everything in the binary to standard output.

Covers the crates that cargo links into `molmesh`, and into other packages of the workspace that are named (normal
dependencies for the target and features), with all their licence and notice files, meshoptimizer, the standard library,
musl if the target uses it, and third-party parts of the web pages. For a crate without a licence file, the text of a
licence that it names is used: Apache-2.0, or MIT with its authors. If the crate permits neither, it has the licence
files of another crate of its repository. Without any, the command fails and names it.

Usage: deploy/notices.py [--target TRIPLE] [--no-default-features] [--package molmesh-python]
"""

import argparse
import collections
import json
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Names of files and folders with licences or notices.
NAMES = re.compile(r"^(licen[cs]e|copying|copyright|notice|unlicense)", re.IGNORECASE)
# Source files are not licence texts. Files for tests and examples are not part of the binary.
SOURCES = (".rs", ".py", ".toml", ".json", ".go", ".sh", ".c", ".h")
UNUSED = {"tests", "test", "examples", "benches", ".github"}
MOST_BYTES = 1 << 20
# Packages bundled in the page at /. The build of the page checks that the texts are up to date.
VIEWER = (
    ("three.js", "three.txt"),
    ("3d-tiles-renderer", "3d-tiles-renderer.txt"),
    ("meshoptimizer's decoder", "meshoptimizer.txt"),
)


def cargo(*arguments):
    done = subprocess.run(["cargo", *arguments], cwd=ROOT, check=True, stdout=subprocess.PIPE)
    return done.stdout


def host():
    lines = subprocess.run(["rustc", "-vV"], check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    return next(line.split()[1] for line in lines if line.startswith("host:"))


def linked(metadata, target, chosen, others):
    """Returns the packages linked into molmesh and `others`, sorted, without those of the workspace."""
    # `cargo metadata` joins the features of all members of the workspace; `cargo tree` takes those of one package.
    tree = ["tree", "--locked", "--edges=normal", "--prefix=none", "--format={p}", f"--target={target}", *chosen]
    lines = cargo(*tree, *(f"--package={name}" for name in ["molmesh", *others])).decode().splitlines()
    crates = {tuple(line.split()[:2]) for line in lines if line}
    # Packages of the workspace have no source.
    packages = [p for p in metadata["packages"] if p["source"] and (p["name"], f"v{p['version']}") in crates]
    return sorted(packages, key=lambda p: (p["name"], p["version"]))


def files(folder):
    """Returns licence and notice files of a crate and of bundled code, such as C sources."""

    def wanted(path):
        parts = path.relative_to(folder).parts
        named = NAMES.match(path.name) or (len(parts) > 1 and parts[-2].lower() == "licenses")
        return named and path.suffix not in SOURCES and not UNUSED & set(parts[:-1])

    found = [p for p in sorted(folder.rglob("*")) if p.is_file() and wanted(p)]
    large = [p for p in found if p.stat().st_size > MOST_BYTES]
    if large:
        sys.exit(f"too large for a licence: {large}")
    return found


def fallback_text(package):
    """Returns name and text of a licence for a crate without a licence file."""
    allowed = package["license"] or ""
    if re.search(r"\bApache-2\.0\b", allowed):
        return "Apache License 2.0", (ROOT / "LICENSE-APACHE").read_text()
    if re.search(r"\bMIT\b", allowed):
        authors = ", ".join(re.sub(r"\s*<[^>]*>", "", a) for a in package["authors"]) or f"the {package['name']} authors"
        return "MIT", mit(authors)
    return None


def sibling_text(package, packages):
    """Returns name and text of the licence of another crate of the same repository with the same licence."""
    for other in packages:
        if all(package[key] and other[key] == package[key] for key in ("repository", "license")):
            for path in files(pathlib.Path(other["manifest_path"]).parent):
                return f"that of {other['name']}", path.read_text(encoding="utf-8", errors="replace")
    return None


def mit(authors):
    """Returns the MIT licence with `authors` as copyright holders."""
    terms = (ROOT / "LICENSE-MIT").read_text()
    at = terms.index("Permission is hereby granted")
    return f"MIT License\n\nCopyright (c) {authors}\n\n{terms[at:]}"


def texts(packages, musl):
    """Maps each distinct licence text to the crates that it belongs to."""
    of = collections.OrderedDict()

    def add(text, who):
        lines = [line.rstrip() for line in text.replace("\f", "\n").strip().splitlines()]
        of.setdefault("\n".join(lines), []).append(who)

    missing = []
    for package in packages:
        who = f"{package['name']} {package['version']}"
        folder = pathlib.Path(package["manifest_path"]).parent
        own = files(folder)
        for path in own:
            add(path.read_text(encoding="utf-8", errors="replace"), f"{who} ({path.relative_to(folder)})")
        # A notice is not a licence.
        if not any(not path.name.lower().startswith("notice") for path in own):
            text = fallback_text(package) or sibling_text(package, packages)
            if text is None:
                missing.append(f"{who}: {package['license']}")
            else:
                add(text[1], f"{who} (without a licence file; {text[0]} of {package['license']})")
    web = ROOT / "web" / "swagger"
    for name in ("LICENSE", "NOTICE", "swagger-ui-bundle.js.LICENSE.txt"):
        add((web / name).read_text(encoding="utf-8"), f"Swagger UI ({name})")
    for name, file in VIEWER:
        add((ROOT / "web" / "licences" / file).read_text(encoding="utf-8"), f"{name} (in the page at /)")
    add(mit("2016-2026 Arseny Kapoulkine"), "meshoptimizer, in the crate meshopt (MIT)")
    if musl:
        add(mit("2005-2020 Rich Felker, et al."), "musl libc (MIT)")
    std = "the Rust standard library (MIT OR Apache-2.0)"
    add((ROOT / "LICENSE-APACHE").read_text(), std)
    if missing:
        sys.exit("no text of a licence for:\n" + "\n".join(missing))
    return of


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--target", default=host())
    parser.add_argument("--no-default-features", action="store_true")
    parser.add_argument("--package", action="append", default=[])
    options = parser.parse_args()
    target, musl = options.target, options.target.endswith("-musl")
    chosen = ["--no-default-features"] if options.no_default_features else []
    metadata = json.loads(cargo("metadata", "--format-version=1", "--locked", f"--filter-platform={target}"))
    packages = linked(metadata, target, chosen, options.package)
    line = "-" * 100
    print("molmesh is licensed under MIT OR Apache-2.0, at your option. It contains third-party software, listed here with")
    print(f"its licences ({target}).\n")
    for package in packages:
        print(f"  {package['name']} {package['version']}: {package['license'] or 'see its text'}")
    print("  Swagger UI, in the page at /docs: Apache-2.0")
    for name, _ in VIEWER:
        print(f"  {name}, in the page at /: MIT")
    print("  meshoptimizer, in the crate meshopt: MIT")
    if "-linux-" in target:
        print(
            "  libstdc++: GPL-3.0-or-later with the GCC Runtime Library Exception,"
            " which permits this use without conditions"
        )
    if musl:
        print("  musl libc: MIT")
    print("  the Rust standard library: MIT OR Apache-2.0")
    for text, who in texts(packages, musl).items():
        print(f"\n{line}\n" + "\n".join(who) + f"\n{line}\n\n{text}")


if __name__ == "__main__":
    main()
