#!/bin/sh
# Make a virtual environment with pip in it: make-venv.sh PYTHON VENV
#
# Debian ships Python without ensurepip, which `python3 -m venv` needs. As root
# the missing package is installed; anyone else is told its name.
set -eu

python=$1
venv=$2

fail() {
    echo "slatprep: $1" >&2
    exit 1
}

command -v "$python" >/dev/null 2>&1 ||
    fail "there is no '$python'; install Python 3.11 or newer, or name one: make PYTHON=/path/to/python3"

version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "'$python' is Python $version; Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"

has_ensurepip() {
    "$python" -c 'import ensurepip, venv' >/dev/null 2>&1
}

if ! has_ensurepip && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing python$version-venv, without which Debian's Python makes no environment" >&2
    apt-get update -qq >&2 || true
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        "python$version-venv" >&2 || true
fi

echo "making the environment $venv with Python $version" >&2
if has_ensurepip; then
    "$python" -m venv "$venv" || { rm -rf "$venv"; fail "'$python -m venv $venv' failed"; }
elif "$python" -m virtualenv --version >/dev/null 2>&1; then
    "$python" -m virtualenv --quiet "$venv"
else
    fail "Python $version cannot make an environment here; run: sudo apt-get install python$version-venv"
fi
