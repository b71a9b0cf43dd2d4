#!/bin/sh
# Installs the outside oracles of the tests (trimesh, gemmi, gltf-validator) into target/test-tools, which git
# ignores. Does nothing when they are there and up to date; says nothing unless it installs or fails.
set -eu

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
root=$(CDPATH='' cd -- "$here/../.." && pwd)
tools=$root/target/test-tools
python=${PYTHON:-python3}

fail() {
    echo "tests/tools/setup.sh: $*" >&2
    exit 1
}

for command in "$python" node npm; do
    command -v "$command" >/dev/null 2>&1 || fail "\`$command\` is not installed; the tests need Python 3.11 or later and Node 20 or later"
done

# A stamp says what an installation was made from; it is written last, so a broken one is made again.
digest() {
    "$python" -c 'import hashlib, sys
print(hashlib.sha256(b"\0".join(open(p, "rb").read() for p in sys.argv[2:]) + sys.argv[1].encode()).hexdigest())' "$@"
}

mkdir -p "$tools"
# Two test runs may start at once: the second waits for the first one's installation.
if command -v flock >/dev/null 2>&1; then
    exec 9>"$tools/.lock"
    flock 9
fi

stamp=$(digest "$("$python" -VV) $root" "$here/requirements.txt")
if [ "$(cat "$tools/venv/.stamp" 2>/dev/null)" != "$stamp" ]; then
    echo "installing the Python tools of the tests into target/test-tools/venv" >&2
    rm -rf "$tools/venv"
    "$python" -m venv "$tools/venv" >&2 || fail "cannot make a virtual environment (Debian: apt install python3-venv)"
    "$tools/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input \
        -r "$here/requirements.txt" >&2 || fail "pip could not install tests/tools/requirements.txt"
    echo "$stamp" >"$tools/venv/.stamp"
fi

stamp=$(digest "$(node --version)" "$here/package.json" "$here/package-lock.json")
if [ "$(cat "$tools/node/.stamp" 2>/dev/null)" != "$stamp" ]; then
    echo "installing the Node tools of the tests into target/test-tools/node" >&2
    rm -rf "$tools/node"
    mkdir -p "$tools/node"
    cp "$here/package.json" "$here/package-lock.json" "$tools/node/"
    (cd "$tools/node" && npm ci --silent --no-audit --no-fund >&2) || fail "npm could not install tests/tools/package.json"
    echo "$stamp" >"$tools/node/.stamp"
fi
