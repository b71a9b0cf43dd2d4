#!/bin/sh
# Builds the web page into web/dist and the package @molmesh/client into web/client/dist. Does nothing if they are up to
# date, and prints only when it builds or fails.
set -eu
cd "$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)"

fail() {
    echo "web/build.sh: $*" >&2
    exit 1
}

for command in node npm; do
    command -v "$command" >/dev/null 2>&1 || fail "\`$command\` is not installed; building the web page needs Node 20.19 or later"
done
node -e 'const [a, b] = process.versions.node.split(".").map(Number); process.exit(a > 20 || (a === 20 && b >= 19) ? 0 : 1)' ||
    fail "Node $(node --version) is too old; building the web page needs Node 20.19 or later"

# If two builds start at once, the second waits for the first.
if command -v flock >/dev/null 2>&1; then
    mkdir -p node_modules
    exec 9>node_modules/.lock
    flock 9
fi

# A stamp is the digest of the inputs. It is written last, so an interrupted build is repeated.
digest() {
    { node --version; for file; do echo "$file"; cat "$file"; done; } | node -e '
        const hash = require("node:crypto").createHash("sha256");
        process.stdin.on("data", (data) => hash.update(data)).on("end", () => console.log(hash.digest("hex")))'
}

stamp=$(digest package.json package-lock.json)
if [ "$(cat node_modules/.stamp 2>/dev/null)" != "$stamp" ]; then
    echo "installing packages into web/node_modules" >&2
    npm ci --silent --no-audit --no-fund >&2 || fail "npm could not install web/package.json"
    echo "$stamp" >node_modules/.stamp
fi

# shellcheck disable=SC2046 # source file names contain no blanks
stamp=$(digest $(find src public licences index.html vite.config.js pack.mjs tsconfig.json package-lock.json client ../openapi.yaml ../LICENSE-* \
    -type f ! -path 'client/dist/*' ! -path 'client/test/*' | LC_ALL=C sort))
if [ "$(cat dist/.stamp 2>/dev/null)" != "$stamp" ] || [ ! -d client/dist/viewer ]; then
    echo "building the web page into web/dist, and the package @molmesh/client into web/client/dist" >&2
    rm -rf client/dist
    log=$(mktemp)
    npm run --silent build >"$log" 2>&1 || { cat "$log" >&2; rm -f "$log"; fail "the build of the web page failed"; }
    rm -f "$log"
    echo "$stamp" >dist/.stamp
fi
