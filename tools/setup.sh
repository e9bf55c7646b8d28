#!/bin/sh
# Sets up everything `make demo` and `make test` need. Idempotent: starts in a second when nothing is
# missing. System libraries come by apt where we may install; otherwise one line names the command.
set -eu
cd "$(dirname "$0")/.."
. tools/apt.sh

PACKAGES=""
need_library() {  # need_library SONAME DEBIAN_PACKAGE
    /sbin/ldconfig -p 2>/dev/null | grep -q "$1" || PACKAGES="$PACKAGES $2"
}
need_library libEGL.so.1 libegl1
need_library libGL.so.1 libgl1
need_library libGLdispatch.so.0 libglvnd0
need_library libusb-1.0.so.0 libusb-1.0-0
need_library libgomp.so.1 libgomp1
need_library libX11.so.6 libx11-6
ls /usr/lib/*/dri/swrast_dri.so >/dev/null 2>&1 || ls /usr/lib/*/libgallium*.so >/dev/null 2>&1 ||
    PACKAGES="$PACKAGES libgl1-mesa-dri"
ls /usr/share/glvnd/egl_vendor.d/*mesa*.json >/dev/null 2>&1 || PACKAGES="$PACKAGES libegl-mesa0"

find_python() {
    for name in python3.13 python3.12 python3.11 python3; do
        if command -v "$name" >/dev/null 2>&1 &&
            "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
            echo "$name"
            return
        fi
    done
}
PYTHON="$(find_python)"
if [ ! -x .venv/bin/python ]; then
    if [ -z "$PYTHON" ]; then
        PACKAGES="$PACKAGES python3 python3-venv"
    elif ! "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null; then
        PACKAGES="$PACKAGES python3-venv"
    fi
fi

if [ -n "$PACKAGES" ]; then
    install_packages setup "$PACKAGES"
    PYTHON="$(find_python)"
fi
[ -n "$PYTHON" ] || [ -x .venv/bin/python ] || {
    echo "setup: Python 3.11, 3.12 or 3.13 is needed; found $(python3 --version 2>&1 || echo none)" >&2
    exit 1
}

STAMP="$(cat requirements.lock pyproject.toml tools/setup.sh | cksum) $(pwd)"
if [ -x .venv/bin/python ] && [ "$(cat .venv/.likeness-setup 2>/dev/null)" = "$STAMP" ]; then
    exit 0
fi
[ -x .venv/bin/python ] || {
    echo "setup: creating .venv with $PYTHON" >&2
    "$PYTHON" -m venv .venv
}
echo "setup: installing pinned requirements (about 2 GB, minutes on a first run)" >&2
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-warn-script-location -r requirements.lock
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
echo "$STAMP" > .venv/.likeness-setup
echo "setup: done" >&2
