"""`slatprep transfer` and `simulate`: give particles materials, and move them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from slatprep.cli import options
from slatprep.cli.output import Output
from slatprep.cli.signature import command
from slatprep.errors import ConfigError

if TYPE_CHECKING:
    from slatprep.particles.fields import Points, VoxelField
    from slatprep.particles.motion import Scene


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Source of materials: an asset of a store, or a prediction.

    Attributes
    ----------
    prediction : FILE.npz
        Predicted materials instead of an asset, as `slatprep evaluate` takes them: coords,
        material or logits, and properties or properties_si.
    ranges : pixie|FILE
        Ranges of a prediction's properties, if its file has none.
    """

    store: options.StoreOption | None = None
    asset: options.AssetOption | None = None
    prediction: options.File | None = None
    ranges: str | None = None

    def field(self, output: Output, points: Points) -> VoxelField:
        """Return the materials of the stored asset or of the prediction that is given."""
        from slatprep.export.formats import clipped_values
        from slatprep.normalize import PIXIE_RANGES
        from slatprep.particles.fields import predicted_field, stored_field
        from slatprep.readers.ranges import read_ranges

        store, ranges, normalization = self.store, self.ranges, None
        if (self.asset is None) == (self.prediction is None):
            raise ConfigError("expected either --asset, with --store, or --prediction")
        if self.asset is not None:
            if store is None or ranges is not None:
                raise ConfigError(
                    "--asset needs --store, which knows the ranges; --ranges does not go"
                )
            opened = options.opened(store)
            options.note_numbered(output, opened, [self.asset])
            for remark in clipped_values(opened, [opened.ids[opened.match(self.asset)]], points):
                output.note(remark)
            return stored_field(opened, self.asset, points)
        if points != "slat" or (store is not None and ranges is not None):
            raise ConfigError(
                "--prediction goes with --store or --ranges, and without --points grid"
            )
        if ranges is not None:
            normalization = PIXIE_RANGES if ranges == "pixie" else read_ranges(Path(ranges))
        elif store is not None:
            normalization = options.opened(store).normalization
        return predicted_field(self.prediction, normalization)  # type: ignore[arg-type]


@command()
def transfer(
    output: Output,
    particles: options.File,
    *,
    material: MaterialOptions,
    out: options.NewFile,
    points: Annotated[Any, options.ChoiceOf("slatprep.particles.fields:Points")] = "slat",
    axes: Annotated[Any | None, options.ChoiceOf("slatprep.particles.read:Axes")] = None,
    frame: Literal["file", "slat"] = "file",
    max_distance: options.Above0 = 2.0,
    far: Annotated[Any, options.ChoiceOf("slatprep.particles.transfer:Far")] = "background",
) -> None:
    """Give each particle of PARTICLES the material of the nearest voxel.

    PARTICLES is a PLY of Gaussians in TRELLIS's format, any other PLY with
    x, y and z, or an npy or npz of positions. The result is a PLY with the
    columns of Pixie's material fields, in SI units, for PhysGaussian.

    Parameters
    ----------
    out : FILE.ply
        File to write, with the particles and their materials.
    points
        Take an asset's materials from its SLAT voxels (a surface) or from its PixieVerse field (a
        solid).
    axes
        Axes of the particles: those of TRELLIS's Gaussians, of its meshes, or of the SLAT frame.
        [default: as a PLY of slatprep states; for Gaussians of TRELLIS and SAM 3D the axes that
        fit; else slat]
    frame
        Write positions as in the particles' file, or in the SLAT frame.
    max_distance : VOXELS
        Largest distance to the nearest voxel; particles beyond it are far.
    far
        Give far particles class 7 and properties 0, omit them, or give them the nearest material.

    Example
    -------
    slatprep transfer gaussians.ply --store data/demo.zarr --asset 5f61cc --out materials.ply
    slatprep transfer solid.npy --store data/demo.zarr --asset 5f61cc --points grid --out solid.ply
    slatprep transfer gaussians.ply --prediction predictions/5f61cc.npz --out predicted.ply
    """
    from slatprep.particles import transfer as work
    from slatprep.particles.read import read_particles

    field = material.field(output, points)
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


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """Forces on the object, and the length and resolution of its motion.

    Attributes
    ----------
    size : METRES
        Width of the unit cube.
    height : METRES
        Height of the fall.
    wind : M/S
        Wind along x. The object then stands without gravity, held at its foot and in parts that are
        stationary or sand.
    seconds
        Length of the motion.
    rate
        Frames per second.
    substeps
        Time steps per frame.
    device
        Device that computes: cpu, cuda:0. [default: the GPU if there is one]
    """

    size: options.Above0 = 0.4
    height: Annotated[float, options.FiniteRange(min=0)] = 0.1
    wind: Annotated[float, options.FiniteRange()] = 0.0
    seconds: options.Above0 = 0.6
    rate: options.Positive = 30
    substeps: options.Positive = 4
    device: str | None = None


@command()
def simulate(
    output: Output,
    *,
    gaussians: options.File | None = None,
    source: MaterialOptions,
    material: Annotated[Any | None, options.ChoiceOf("slatprep.particles.motion:CLASSES")] = None,
    young: options.Above0 | None = None,
    density: options.Above0 | None = None,
    out: options.NewFolder,
    picture: options.NewFile | None = None,
    axes: Annotated[Any | None, options.ChoiceOf("slatprep.particles.read:Axes")] = None,
    stretch: bool = False,
    particles: Annotated[int, click.IntRange(min=4, max=256)] = 32,
    motion: MotionOptions,
) -> None:
    """Simulate an object of a store or of a prediction, and move its Gaussians.

    Particles fill the object and take the materials of its voxels; Newton's
    material point method moves them on a CPU or a GPU. Gaussians move with the
    particles around them: positions and rotations change, all other attributes
    stay. Needs Newton: pip install 'slatprep[simulate]'.

    Parameters
    ----------
    gaussians : FILE.ply
        PLY of the object's Gaussians, in the format of TRELLIS, SAM 3D Objects or PhysGaussian.
        [default: a Gaussian for each particle, in the colour of its class]
    material
        Take this class for the whole object.
    young : PA
        Take this Young's modulus for the whole object.
    density : KG/M3
        Take this density for the whole object.
    out
        Folder of the frames, frame-0000.ply and so on.
    picture : FILE
        Also draw the frames: an animation (gif, webp) or a strip of five (png). An existing file
        is replaced.
    axes
        Axes of the Gaussians. [default: the axes that fit]
    stretch
        Let the scales of Gaussians follow the deformation too.
    particles
        Number of particles along each axis of the cube.

    Example
    -------
    slatprep simulate --store data/demo.zarr --asset 5f61cc --out frames --picture fall.gif
    slatprep simulate --gaussians cup.ply --prediction out/cup.npz --ranges pixie --out frames
    slatprep simulate --store data/demo.zarr --asset 5f61cc --out frames --wind 8
    """
    from slatprep.particles import motion as work
    from slatprep.particles.gaussians import require_picture

    if picture is not None:
        require_picture(picture)
    work.old_frames(Path(out))  # Not only once all is computed.
    scene: Scene = work.prepare(
        source.field(output, "grid" if source.asset is not None else "slat"),
        gaussians,
        axes,
        particles,
        material,
        young,
        density,
    )
    for note in scene.notes:
        output.note(note)
    work.require_writable(Path(out), *([picture.absolute().parent] if picture else ()))
    begin = time.perf_counter()
    with output.progress("simulate", "frames") as progress:
        moved = work.run(scene, **vars(motion), progress=progress)
    computed = time.perf_counter() - begin
    output.if_stopped = f"{out} holds frames of the old run, the new one, or both; run it again"
    with output.progress("write", "frames") as progress:
        count = work.write_frames(
            Path(out), scene, moved, motion.rate, picture, stretch, progress=progress
        )
    counts = {
        "particles": len(scene.positions),
        "gaussians": len(scene.vertices),
        "frames": count,
        "seconds": computed,
    }
    output.counted(f"Frames in {out}", counts, path=out)
