# Selects the container engine for the scripts that source this file. `pick_engine` sets the array `engine`, the start
# of a command. Uses docker if its daemon answers, else podman, and installs podman as root on Debian. ENGINE=docker or
# ENGINE=podman overrides the choice.

pick_engine() {
    case ${ENGINE:-} in
    docker | podman) engine=("$ENGINE") ;;
    '')
        if docker info >/dev/null 2>&1; then
            engine=(docker)
        else
            command -v podman >/dev/null || install_packages podman runc
            engine=(podman)
        fi
        ;;
    *) echo "ENGINE=$ENGINE is not known; expected docker or podman" >&2; exit 2 ;;
    esac
    # Unlike crun, runc supports hosts with both cgroup versions.
    if [ "${engine[0]}" = podman ] && command -v runc >/dev/null; then engine+=(--runtime "$(command -v runc)"); fi
}

# Ends the script with 3: this machine lacks what the script needs.
impossible() {
    echo "$1" >&2
    exit 3
}

# Installs Debian packages. Prints the log only on failure. Exits with 3 without root, apt-get or a network.
install_packages() {
    if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
        impossible "missing packages: $*; installing them needs root and apt-get"
    fi
    echo "installing $*" >&2
    local log
    log=$(mktemp)
    local -x DEBIAN_FRONTEND=noninteractive LC_ALL=C
    if ! { apt-get update -q && apt-get -o DPkg::Lock::Timeout=300 install -qy --no-install-recommends "$@"; } >"$log" 2>&1; then
        tail -20 "$log" >&2
        if grep -q 'Failed to fetch' "$log"; then impossible "apt-get cannot fetch $*"; fi
        exit 1
    fi
    rm -f "$log"
}
