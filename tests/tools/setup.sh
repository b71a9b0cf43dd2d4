#!/bin/sh
# Installs the outside oracles of the tests (trimesh, gemmi, moto, schemas, gltf-validator, promtool) into target/test-tools, which git
# ignores, and into the system, where there is none, Mesa's software Vulkan (lavapipe), on which the shaders are tested, and
# Chromium, in which the viewer is. Does nothing when all is there and up to date; says nothing unless it installs or fails.
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

# Drivers announce themselves by a manifest; the loader finds lavapipe by its own.
software_vulkan() {
    for folder in /usr/share/vulkan/icd.d /usr/local/share/vulkan/icd.d /etc/vulkan/icd.d; do
        for manifest in "$folder"/lvp_icd*.json; do
            if [ -e "$manifest" ]; then return 0; fi
        done
    done
    # Elsewhere (macOS, a driver named by hand) the tests say what they miss.
    [ "$(uname -s)" != Linux ] || [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ]
}

install() {
    echo "installing $1, $2" >&2
    as_root=
    if [ "$(id -u)" -ne 0 ]; then as_root="sudo -n"; fi
    log=$(mktemp)
    { $as_root apt-get update -qq &&
        $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$1"; } >"$log" 2>&1 ||
        { tail -5 "$log" >&2; rm -f "$log"; fail "apt-get could not install $1; install it as root"; }
    rm -f "$log"
}

if ! software_vulkan; then
    command -v apt-get >/dev/null 2>&1 ||
        fail "the tests of the shaders need Mesa's software Vulkan (lavapipe): install it (Fedora: mesa-vulkan-drivers, Arch: vulkan-swrast)"
    install mesa-vulkan-drivers "for the tests of the shaders"
fi

browser() {
    for name in chromium chromium-browser google-chrome; do
        if command -v "$name" >/dev/null 2>&1; then return 0; fi
    done
    # Elsewhere the tests say what they miss.
    ! command -v apt-get >/dev/null 2>&1
}

if ! browser; then install chromium "for the tests of the viewer"; fi

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

# Prometheus' tool for rules, taken out of Debian's package: the package would bring a server, and start it.
if [ ! -x "$tools/promtool" ]; then
    if command -v apt-get >/dev/null 2>&1 && command -v dpkg-deb >/dev/null 2>&1; then
        echo "taking promtool out of the package prometheus into target/test-tools" >&2
        folder=$(mktemp -d)
        get() { (cd "$folder" && apt-get download -qq prometheus) >"$folder/log" 2>&1; }
        as_root=
        if [ "$(id -u)" -ne 0 ]; then as_root="sudo -n"; fi
        # Where nothing is known of packages, or of older ones alone, the lists come first.
        get || { $as_root apt-get update -qq >>"$folder/log" 2>&1 && get; } ||
            { tail -5 "$folder/log" >&2; rm -rf "$folder"; fail "apt-get could not download the package prometheus"; }
        dpkg-deb --fsys-tarfile "$folder"/prometheus_*.deb | tar -x -C "$folder" ./usr/bin/promtool
        mv "$folder/usr/bin/promtool" "$tools/promtool.new" && mv "$tools/promtool.new" "$tools/promtool"
        rm -rf "$folder"
    else
        echo "tests/tools/setup.sh: without apt-get, put promtool (of Prometheus) into target/test-tools by hand" >&2
    fi
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
