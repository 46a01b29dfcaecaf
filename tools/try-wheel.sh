#!/bin/sh
# Build a wheel and try it as a user gets it: try-wheel.sh PYTHON DIST
#
# In an environment of its own, from another folder, so that neither the
# checkout nor what the tests need can stand in for a file left out.
set -eu

python=$1
dist=$2

rm -rf build/lib build/bdist.* # setuptools would pack what an older checkout left there
mkdir -p "$dist"
rm -f "$dist"/slatprep-*.whl
"$python" -m pip wheel --disable-pip-version-check --quiet --no-deps --wheel-dir "$dist" .
rm -rf build/lib build/bdist.*
wheel=$(cd "$dist" && pwd)/$(cd "$dist" && ls slatprep-*.whl)

away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
sh tools/make-venv.sh "$python" "$away/venv" 2>/dev/null
sh tools/install.sh "$away/venv" "$wheel"

cd "$away"
unset PYTHONPATH
venv/bin/slatprep --version
venv/bin/python -c "
import slatprep
from pathlib import Path
assert Path(slatprep.__file__).is_relative_to('$away'), slatprep.__file__"
venv/bin/slatprep make-demo demo --assets 2 --quiet
venv/bin/slatprep build-store --pixieverse demo/pixieverse --slat demo/slat \
    --out demo.zarr --jobs 1 --quiet
venv/bin/slatprep verify demo.zarr --quiet
venv/bin/slatprep report demo.zarr --out demo.html --quiet
test -s demo.html
echo "wheel: $wheel"
