#!/bin/sh
# Resolve the locks anew: lock.sh VENV
#
# Writes requirements/run.txt (what a build needs) and requirements/test.txt
# (what tests, linters and docs need besides). One file serves every Python
# from 3.11 on and every platform: what differs carries a marker.
set -eu

venv=$1
uv="$venv/bin/uv pip compile pyproject.toml --universal --python-version 3.11
    --upgrade --no-header --no-annotate --quiet"

header() {
    echo "# $1"
    echo "# Written by 'make lock' from pyproject.toml; do not edit."
}

# Torch is installed before, in its CPU build (requirements/torch.txt), which
# needs none of the CUDA packages that the resolver sees in the index's build.
{
    header "What tests, linters and the documentation need, torch excepted (torch.txt)."
    $uv --extra dev --constraint requirements/torch.txt --no-emit-package torch |
        grep -vE '^(nvidia-|cuda-|triton)'
} >requirements/test.txt.new
mv requirements/test.txt.new requirements/test.txt

# The same versions where both have a package: a run is what was tested.
{
    header "What building and reading a store needs."
    $uv --constraint requirements/test.txt
} >requirements/run.txt.new
mv requirements/run.txt.new requirements/run.txt
