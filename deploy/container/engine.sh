# What builds and runs images here, sourced by build.sh: sets `engine`, an array that begins a command.
# Takes docker where its daemon answers, else podman; installs the latter where this is root on Debian. ENGINE=docker or
# ENGINE=podman decides it.

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
    # runc runs where cgroups are of both versions at once; crun does not.
    if [ "${engine[0]}" = podman ] && command -v runc >/dev/null; then engine+=(--runtime "$(command -v runc)"); fi
}

# Installs Debian packages, quietly unless that fails.
install_packages() {
    if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
        echo "not installed and cannot be installed here: $*; needs root and apt-get" >&2
        exit 1
    fi
    echo "installing $*" >&2
    local log
    log=$(mktemp)
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -qy --no-install-recommends "$@"; } >"$log" 2>&1 ||
        { tail -20 "$log" >&2; exit 1; }
    rm -f "$log"
}
