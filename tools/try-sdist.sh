#!/bin/sh
# Build a source archive and run a part of its tests from it: try-sdist.sh PYTHON DIST
set -eu

python=$1
dist=$2

mkdir -p "$dist"
rm -f "$dist"/slatprep-*.tar.gz
"$python" -c "
import sys
from setuptools.build_meta import build_sdist
build_sdist(sys.argv[1])" "$dist" >/dev/null
archive=$(cd "$dist" && pwd)/$(cd "$dist" && ls slatprep-*.tar.gz)
python=$(cd "$(dirname "$python")" && pwd)/$(basename "$python")

away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
tar -xzf "$archive" -C "$away"
cd "$away"/slatprep-*
# From here, python -m finds the archive's package before any that is installed.
"$python" -m pytest -p no:cacheprovider tests/geometry tests/docs/test_architecture.py tests/test_requirements.py
echo "source archive: $archive"
