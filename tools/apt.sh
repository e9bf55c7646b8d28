# Sourced by the other set-up scripts.

# install_packages WHO PACKAGES: by apt where we may; otherwise one line names the command, and WHO ends.
install_packages() {
    command -v apt-get >/dev/null 2>&1 || {
        echo "$1: missing system packages; install with your package manager:$2" >&2
        exit 1
    }
    if [ "$(id -u)" -eq 0 ]; then
        AS_ROOT=""
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
        AS_ROOT="sudo -n"
    else
        echo "$1: run this once, then try again: sudo apt-get install -y$2" >&2
        exit 1
    fi
    echo "$1: installing system packages:$2" >&2
    $AS_ROOT apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive $AS_ROOT apt-get install -y -qq --no-install-recommends $2 >/dev/null
}
