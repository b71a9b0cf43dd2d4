#!/usr/bin/env bash
# Checks Cargo.lock against RustSec's advisories. Installs cargo-audit into target/tools if it is missing.
#
# ADVISORY_DB=FOLDER uses a copy of the database instead of fetching it. A check without a database fails unless
# ALLOW_SKIP=1 is set. Exit codes: 0 nothing found or skip permitted, 1 advisories found, 2 invalid database, 3 skipped.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

version=0.22.2
export PATH="$PWD/target/tools/bin:$PATH"
if ! cargo audit --version 2>/dev/null | grep -qF "$version"; then
    cargo install --locked --root target/tools "cargo-audit@$version"
fi

db=${ADVISORY_DB:-}
if [ -z "$db" ]; then
    # A separate step, so a failed fetch cannot be mistaken for a failed check.
    db=target/advisory-db
    url=https://github.com/RustSec/advisory-db.git
    log=$(mktemp)
    trap 'rm -f "$log"' EXIT
    rm -rf "$db"
    if ! GIT_TERMINAL_PROMPT=0 timeout 300 git clone --quiet --depth 1 "$url" "$db" 2>"$log"; then
        echo "SKIPPED: advisories were not checked: $url cannot be fetched: $(tail -1 "$log")"
        [ "${ALLOW_SKIP:-0}" = 1 ] && exit 0
        exit 3
    fi
fi
if ! [ -d "$db/crates" ]; then
    echo "$db contains no advisories: it has no folder named crates" >&2
    exit 2
fi
cargo audit --no-fetch --db "$db" --deny warnings
