#!/bin/sh
# Makes alignment.png beside this file: a demo asset in two frames that no quarter turn joins.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
slatprep make-demo "$work/demo" --assets 1 --seed 0 --level 3 --quiet
slatprep build-store --config "$work/demo/dataset.toml" --out "$work/demo.zarr" --quiet
slatprep check-alignment --store "$work/demo.zarr" --worst 1 --picture "$here/alignment.png"
# Makes statistics.png of 24 demo assets.
slatprep make-demo "$work/many" --assets 24 --seed 0 --quiet
slatprep build-store --config "$work/many/dataset.toml" --out "$work/demo24.zarr" --quiet
slatprep stats "$work/demo24.zarr" --picture "$here/statistics.png" --quiet
# Draws the diagrams: frames, deformation, verdict, update, arrays.
python "$here/diagrams.py"
