#!/bin/sh
# Sets up what `make test-gige` needs on top of tools/setup.sh: Aravis, PyGObject and `ip`. Idempotent:
# starts in a second when nothing is missing. Where we may not install, one line names the command.
set -eu
cd "$(dirname "$0")/.."
. tools/apt.sh

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
    install_packages setup-gige "$PACKAGES"
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
