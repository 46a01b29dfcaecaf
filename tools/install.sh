#!/bin/sh
# Install slatprep into an environment: install.sh VENV run|hub|paper|test|WHEEL
#
#   run     this checkout, editable, and what building and reading a store needs
#   hub     also what reads hf:// URLs
#   paper   also Open3D, the engine of --preset paper
#   test    all of that, the linters, the tests' and the documentation's tools
#   WHEEL   that file and what it needs
#
# Versions are those of requirements/*.txt, so nothing is left to a resolver.
# LOCKED=no takes what pyproject.toml allows instead, for a Python or platform
# that the locked versions have no wheels for.
set -eu

venv=$1
what=$2
locked=${LOCKED:-yes}
pip="$venv/bin/python -m pip --disable-pip-version-check"

say() {
    echo "slatprep: $1" >&2
}

# pip asks its configuration; uv, which installs the rest, reads none of it.
configured() {
    variable=$(printf '%s' "PIP_$1" | tr a-z- A-Z_)
    eval "value=\${$variable:-}"
    [ -n "$value" ] || value=$($pip config get "global.$1" 2>/dev/null || true)
    printf '%s' "$value" | tr '\n' ' '
}

# The default index has a CUDA build of several GB for Linux. A folder of wheels or
# an index that pip is told of (PIP_FIND_LINKS, PIP_EXTRA_INDEX_URL) may hold the
# CPU build; torch's installation page names an index that does.
install_torch() {
    pin=$(grep '^torch==' requirements/torch.txt)
    [ "$locked" = yes ] || pin=torch
    if "$venv/bin/python" -c "
import sys
from importlib.metadata import version
sys.exit('$pin' not in ('torch', 'torch==' + version('torch').partition('+')[0]))" 2>/dev/null
    then
        return
    fi
    say "installing $pin, its CPU build"
    if [ "$(uname -s)" != Linux ]; then
        $pip install --quiet --no-deps "$pin"
    elif ! $pip install --quiet --no-deps --only-binary :all: "$pin+cpu" 2>/dev/null; then
        say "pip finds no CPU build of $pin, so the default one is taken, which is larger;"
        say "PIP_EXTRA_INDEX_URL=INDEX make test takes it from torch's index of CPU builds"
        $pip install --quiet "$pin"
    fi
}

# Open3D's wheel links libraries of a desktop, which a small Debian leaves out.
install_libraries() {
    [ "$(uname -s)" = Linux ] || return 0
    missing=$("$venv/bin/python" -c "
import ctypes
for name, package in (('X11.so.6', 'libx11-6'), ('GL.so.1', 'libgl1'), ('gomp.so.1', 'libgomp1')):
    try:
        ctypes.CDLL('lib' + name)
    except OSError:
        print(package, end=' ')
")
    [ -n "$missing" ] || return 0
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
        say "installing ${missing% }, without which Open3D cannot be loaded"
        apt-get update -qq >&2 || true
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing \
            >/dev/null 2>&1 && return 0
    fi
    say "Open3D cannot be loaded without ${missing% }; on Debian: sudo apt-get install ${missing% }"
}

case $what in
run) lock=run from='-C editable_mode=compat --editable .' ;;
hub) lock=test from='-C editable_mode=compat --editable .[hub]' ;;
paper) lock=test from='-C editable_mode=compat --editable .[paper]' ;;
test) lock=test from='-C editable_mode=compat --editable .[dev]' ;;
*.whl) lock=run from=$what ;;
*)
    say "nothing is called '$what' here; use run, hub, paper, test or a wheel"
    exit 2
    ;;
esac

[ "$what" != test ] || install_torch
case $what in
paper | test) install_libraries ;;
esac

if [ "$locked" != yes ]; then
    say "installing slatprep for '$what' without the lock"
    $pip install --quiet $from
    exit
fi

say "installing slatprep for '${what##*/}' as locked in requirements/$lock.txt"
if $pip install --quiet --only-binary :all: "uv>=0.9" 2>/dev/null; then
    index=$(configured index-url)
    extra=$(configured extra-index-url)
    links=$(configured find-links)
    [ -z "$index" ] || export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$index}"
    [ -z "$extra" ] || export UV_INDEX="${UV_INDEX:-$extra}"
    [ -z "$links" ] || export UV_FIND_LINKS="${UV_FIND_LINKS:-$(echo "$links" | tr -s ' ' ',')}"
    # As pip: of all indexes the version that is asked for, not the first index's.
    install="$venv/bin/uv pip install --python $venv/bin/python --index-strategy unsafe-best-match
        --quiet"
else
    install="$pip install --quiet" # a platform that uv has no wheel for
fi
case $what in
hub | paper) $install --constraint "requirements/$lock.txt" $from ;;
*)
    $install --no-deps --requirement "requirements/$lock.txt"
    $install --no-deps $from
    ;;
esac
