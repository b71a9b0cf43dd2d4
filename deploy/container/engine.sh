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

# Installs Debian packages. Prints the log only on failure.
install_packages() {
    if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
        echo "missing packages: $*; installing them needs root and apt-get" >&2
        exit 1
    fi
    echo "installing $*" >&2
    local log
    log=$(mktemp)
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -qy --no-install-recommends "$@"; } >"$log" 2>&1 ||
        { tail -20 "$log" >&2; exit 1; }
    rm -f "$log"
}
