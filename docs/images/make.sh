#!/bin/sh
# Makes alignment.png beside this file: a demo asset in two frames that no quarter turn joins.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
slatprep make-demo "$work/demo" --assets 1 --seed 0 --level 3 --quiet
slatprep build-store --config "$work/demo/dataset.toml" --out "$work/demo.zarr" --quiet
slatprep check-alignment --store "$work/demo.zarr" --worst 1 --picture "$here/alignment.png"
