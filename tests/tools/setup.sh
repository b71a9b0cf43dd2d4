#!/bin/sh
# Installs what the tests need: Mesa's software Vulkan, Chromium and strace into the system, if they are missing, and
# promtool, a NATS server, Python and Node packages into target/test-tools. Prints one line per step. Without root,
# skips what needs it and names it at the end; the tests that need it are then skipped too. SKIPPED=FILE collects these
# names.

set -eu

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
root=$(CDPATH='' cd -- "$here/../.." && pwd)
tools=$root/target/test-tools
python=${PYTHON:-python3}
versions="Python 3.11 or later and Node 20.19 or later"
steps=7
step=0
skipped=

say() { echo "test tools $step/$steps: $*" >&2; }

fail() {
    echo "tests/tools/setup.sh: $*" >&2
    exit 1
}

skip() {
    say "skipped: $*"
    skipped="${skipped}SKIPPED: test tools: $*
"
}

for command in "$python" node npm; do
    command -v "$command" >/dev/null 2>&1 ||
        fail "\`$command\` is not installed; the tests need $versions"
done
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "$("$python" -V) is too old; the tests need $versions"
node -e 'const [a, b] = process.versions.node.split(".").map(Number); process.exit(a > 20 || (a === 20 && b >= 19) ? 0 : 1)' ||
    fail "Node $(node --version) is too old; the tests need $versions"

mkdir -p "$tools"
# Of two runs at once, the second waits for the first.
if command -v flock >/dev/null 2>&1; then
    exec 9>"$tools/.lock"
    flock -n 9 || { echo "test tools: waiting for another installation" >&2 && flock 9; }
fi
log=$tools/apt.log

as_root=
if [ "$(id -u)" -ne 0 ]; then as_root="sudo -n"; fi

# Runs apt-get behind the prefix $1 and waits up to five minutes for each lock. `apt-get update` itself has no timeout.
apt_get() {
    prefix=$1
    shift
    tries=60
    until $prefix env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 -qq "$@" >"$log" 2>&1; do
        tries=$((tries - 1))
        grep -q 'Could not get lock /var/lib/apt/lists' "$log" && [ "$tries" -gt 0 ] || return 1
        sleep 5
    done
}

# The same, with a second attempt after an update of the package lists.
apt_get_fresh() {
    apt_get "$@" || { apt_get "$as_root" update && apt_get "$@"; }
}

install() {
    if ! command -v apt-get >/dev/null 2>&1; then
        skip "$1 is not installed, and there is no apt-get; install it with the package manager of this system"
    elif [ -n "$as_root" ] && ! $as_root true 2>/dev/null; then
        skip "$1 is not installed; run \`apt-get install $1\` as root"
    else
        say "installing $1"
        apt_get_fresh "$as_root" install -y --no-install-recommends "$1" || skip "apt-get cannot install $1: $(tail -1 "$log")"
    fi
}

# Drivers register with a manifest.
software_vulkan() {
    for folder in /usr/share/vulkan/icd.d /usr/local/share/vulkan/icd.d /etc/vulkan/icd.d; do
        for manifest in "$folder"/lvp_icd*.json; do
            if [ -e "$manifest" ]; then return 0; fi
        done
    done
    # On other systems, and with a driver named by hand, the tests report what is missing.
    [ "$(uname -s)" != Linux ] || [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ]
}

browser() {
    for name in chromium chromium-browser google-chrome; do
        if command -v "$name" >/dev/null 2>&1; then return 0; fi
    done
    return 1
}

# Extracts the program at path $2 from Debian's package $1. Installing the package would start a server.
from_debian() {
    command -v apt-get >/dev/null 2>&1 && command -v dpkg-deb >/dev/null 2>&1 || return 1
    folder=$(mktemp -d)
    (cd "$folder" && apt_get_fresh "" download "$1" && dpkg-deb --fsys-tarfile "$1"_*.deb | tar -x "./$2" &&
        mv "$2" "$tools/") ||
        { rm -rf "$folder" && return 1; }
    rm -rf "$folder"
}

# The stamp names what an installation was made from. It is written last, so that an interrupted installation is redone.
digest() {
    "$python" -c 'import hashlib, sys
print(hashlib.sha256(b"\0".join(open(p, "rb").read() for p in sys.argv[2:]) + sys.argv[1].encode()).hexdigest())' "$@"
}

step=1
if software_vulkan; then say "software Vulkan is installed"; else install mesa-vulkan-drivers; fi

step=2
if browser; then say "a browser is installed"; else install chromium; fi

step=3
# Only Linux has it.
if [ "$(uname -s)" != Linux ] || command -v strace >/dev/null 2>&1; then say "strace is installed"; else install strace; fi

step=4
if [ -x "$tools/promtool" ]; then
    say "promtool is installed"
else
    say "extracting promtool from Debian's package of Prometheus"
    from_debian prometheus usr/bin/promtool || skip "promtool cannot be had from apt-get; put it into target/test-tools by hand"
fi

step=5
if [ -x "$tools/nats-server" ]; then
    say "a NATS server is installed"
else
    say "extracting the oldest supported NATS server from Debian's package"
    from_debian nats-server usr/sbin/nats-server ||
        skip "a NATS server cannot be had from apt-get; put it into target/test-tools by hand"
fi

step=6
stamp=$(digest "$("$python" -VV) $root" "$here/requirements.txt")
if [ "$(cat "$tools/venv/.stamp" 2>/dev/null)" = "$stamp" ]; then
    say "the Python packages are installed"
else
    say "installing the Python packages into target/test-tools/venv"
    rm -rf "$tools/venv"
    "$python" -m venv "$tools/venv" >&2 || fail "cannot create a virtual environment (Debian: apt install python3-venv)"
    "$tools/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input \
        -r "$here/requirements.txt" >&2 || fail "pip cannot install tests/tools/requirements.txt"
    echo "$stamp" >"$tools/venv/.stamp"
fi

step=7
stamp=$(digest "$(node --version)" "$here/package.json" "$here/package-lock.json")
if [ "$(cat "$tools/node/.stamp" 2>/dev/null)" = "$stamp" ]; then
    say "the Node packages are installed"
else
    say "installing the Node packages into target/test-tools/node"
    rm -rf "$tools/node"
    mkdir -p "$tools/node"
    cp "$here/package.json" "$here/package-lock.json" "$tools/node/"
    (cd "$tools/node" && npm ci --silent --ignore-scripts --no-audit --no-fund >&2) || fail "npm cannot install tests/tools/package.json"
    echo "$stamp" >"$tools/node/.stamp"
fi

printf %s "$skipped" | tee -a "${SKIPPED:-/dev/null}" >&2
