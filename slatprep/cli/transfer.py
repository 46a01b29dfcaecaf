"""`slatprep transfer`: give materials to the particles of a simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from slatprep.cli.options import Above0, AssetOption, ChoiceOf, File, NewFile, StoreOption
from slatprep.cli.output import Output
from slatprep.cli.signature import command
from slatprep.errors import ConfigError

if TYPE_CHECKING:
    from slatprep.particles.fields import Points, VoxelField


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Where materials come from: an asset of a store, or a prediction.

    Attributes
    ----------
    prediction : FILE.npz
        Predicted materials instead of an asset: coords, material, and properties (normalised as
        --store or --ranges says) or properties_si.
    ranges : pixie|FILE
        Ranges of a prediction's properties.
    """

    store: StoreOption | None = None
    asset: AssetOption | None = None
    prediction: File | None = None
    ranges: str | None = None

    def field(self, points: Points) -> VoxelField:
        """Return the materials of a stored asset or of a prediction, one of which is given."""
        from slatprep.normalize import PIXIE_RANGES
        from slatprep.particles.fields import predicted_field, stored_field
        from slatprep.readers.ranges import read_ranges
        from slatprep.store import open_store

        store, ranges, normalization = self.store, self.ranges, None
        if (self.asset is None) == (self.prediction is None):
            raise ConfigError("expected either --asset, with --store, or --prediction")
        if self.asset is not None:
            if store is None or ranges is not None:
                raise ConfigError(
                    "--asset needs --store, which knows the ranges; --ranges does not go"
                )
            return stored_field(open_store(store), self.asset, points)
        if points != "slat" or (store is not None and ranges is not None):
            raise ConfigError(
                "--prediction goes with --store or --ranges, and without --points grid"
            )
        if ranges is not None:
            normalization = PIXIE_RANGES if ranges == "pixie" else read_ranges(Path(ranges))
        elif store is not None:
            normalization = open_store(store).normalization
        return predicted_field(self.prediction, normalization)  # type: ignore[arg-type]


@command()
def transfer(
    output: Output,
    particles: File,
    *,
    material: MaterialOptions,
    out: NewFile,
    points: Annotated[Any, ChoiceOf("slatprep.particles.fields:Points")] = "slat",
    axes: Annotated[Any | None, ChoiceOf("slatprep.particles.read:Axes")] = None,
    frame: Literal["file", "slat"] = "file",
    max_distance: Above0 = 2.0,
    far: Annotated[Any, ChoiceOf("slatprep.particles.transfer:Far")] = "background",
) -> None:
    """Give each particle of PARTICLES the material of the nearest voxel.

    PARTICLES is a PLY of Gaussians as TRELLIS saves it, any other PLY with
    x, y and z, or an npy or npz of positions. The result is a PLY with the
    fields of Pixie's material fields, in SI units, for PhysGaussian.

    Parameters
    ----------
    out : FILE.ply
        Where to write the particles with their materials.
    points
        Take an asset's materials from its SLAT voxels, a surface, or from its PixieVerse field, a
        solid.
    axes
        Axes of the particles: those of TRELLIS's Gaussians, of its meshes, or of the SLAT frame.
        [default: as a PLY of slatprep states; for Gaussians of TRELLIS and SAM 3D those that fit;
        else slat]
    frame
        Write positions as in the particles' file, or in the SLAT frame.
    max_distance : VOXELS
        Distance to the nearest voxel above which a particle is far.
    far
        Give far particles class 7 and properties 0, leave them out, or give them the nearest
        material.

    Example
    -------
    slatprep transfer gaussians.ply --store data/demo.zarr --asset 5f61cc --out materials.ply
    slatprep transfer solid.npy --store data/demo.zarr --asset 5f61cc --points grid --out solid.ply
    slatprep transfer gaussians.ply --prediction predictions/5f61cc.npz --out predicted.ply
    """
    from slatprep.particles import transfer as work
    from slatprep.particles.read import read_particles

    field = material.field(points)
    read, recognised = work.recognise_axes(read_particles(particles, axes), field, max_distance)
    if recognised:
        output.note(f"{particles}: {recognised}")
    result = work.transfer(read.in_slat(), field, max_distance=max_distance, far=far)
    if read.foreign and axes is None:
        output.note(
            f"{particles}: the Gaussians are another tool's than TRELLIS ({read.foreign}): read as "
            "they are, in the SLAT frame; --axes says otherwise"
        )
    doubt = work.doubt_axes(read, field, result, max_distance)
    work.write_transferred(out, read, result, max_distance=max_distance, in_slat=frame == "slat")
    if doubt:
        output.problem(f"{doubt}: {far}")
    elif result.far:
        output.note(
            f"{result.far:,} of {len(read.positions):,} particles have no voxel within "
            f"{max_distance:g} voxels: {far}"
        )
    counts = {
        "particles": len(read.positions),
        "axes": read.axes,
        "written": len(result.rows),
        "far": result.far,
    }
    output.counted(f"Transferred to {out}", counts, path=out)
