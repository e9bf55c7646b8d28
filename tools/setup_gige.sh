#!/bin/sh
# Sets up what `make test-gige` needs on top of tools/setup.sh: Aravis, PyGObject and `ip`. Idempotent:
# starts in a second when nothing is missing. Where we may not install, one line names the command.
set -eu
cd "$(dirname "$0")/.."

PACKAGES=""
need() {  # need DEBIAN_PACKAGE COMMAND...: the package is missing when the command fails
    package="$1"
    shift
    "$@" >/dev/null 2>&1 || PACKAGES="$PACKAGES $package"
}
typelib() {
    ls /usr/lib/*/girepository-1.0/"$1" /usr/lib/girepository-1.0/"$1" 2>/dev/null | grep -q .
}
gobject() {  # PyGObject finds Aravis, and is a version that Debian 12 can hold
    .venv/bin/python -W ignore -c "
import gi
gi.require_version('Aravis', '0.8')
from gi.repository import Aravis
"
}

need gir1.2-aravis-0.8 typelib Aravis-0.8.typelib
need aravis-tools command -v arv-tool-0.8
need iproute2 command -v ip
if ! gobject >/dev/null 2>&1; then
    need pkg-config command -v pkg-config
    need gcc command -v gcc
    need libgirepository1.0-dev pkg-config --exists gobject-introspection-1.0
    need libcairo2-dev pkg-config --exists cairo
    need python3-dev .venv/bin/python -c "
import os, sysconfig
open(os.path.join(sysconfig.get_path('include'), 'Python.h')).close()
"
fi

if [ -n "$PACKAGES" ]; then
    command -v apt-get >/dev/null 2>&1 || {
        echo "setup-gige: missing packages; install with your package manager:$PACKAGES" >&2
        exit 1
    }
    if [ "$(id -u)" -eq 0 ]; then
        AS_ROOT=""
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
        AS_ROOT="sudo -n"
    else
        echo "setup-gige: run this once, then try again: sudo apt-get install -y$PACKAGES" >&2
        exit 1
    fi
    echo "setup-gige: installing system packages:$PACKAGES" >&2
    $AS_ROOT apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive $AS_ROOT apt-get install -y -qq --no-install-recommends $PACKAGES >/dev/null
fi

if ! gobject >/dev/null 2>&1; then
    echo "setup-gige: building PyGObject" >&2
    # Later versions want girepository 2.0, which Debian 12 lacks.
    .venv/bin/python -m pip install --quiet --disable-pip-version-check "PyGObject==3.50.2"
    gobject || {
        echo "setup-gige: PyGObject is installed and does not find Aravis" >&2
        exit 1
    }
fi
