"""`slatprep simulate`: move an object, and write its Gaussians frame by frame."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli.options import Above0, ChoiceOf, File, FiniteRange, NewFile, NewFolder, Positive
from slatprep.cli.output import Output
from slatprep.cli.signature import command
from slatprep.cli.transfer import MaterialOptions

if TYPE_CHECKING:
    from slatprep.particles.motion import Scene


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """What moves the object, for how long, and how finely that is computed.

    Attributes
    ----------
    size : METRES
        Width of the unit cube.
    height : METRES
        Height of the fall.
    wind : M/S
        Wind along x. The object then stands, held at its foot and where it is stationary or sand,
        without gravity.
    seconds
        Length of the motion.
    rate
        Frames a second.
    substeps
        Time steps a frame.
    device
        Where to compute: cpu, cuda:0. [default: the GPU if there is one]
    """

    size: Above0 = 0.4
    height: Annotated[float, FiniteRange(min=0)] = 0.1
    wind: float = 0.0
    seconds: Above0 = 0.6
    rate: Positive = 30
    substeps: Positive = 4
    device: str | None = None


@command()
def simulate(
    output: Output,
    *,
    gaussians: File | None = None,
    source: MaterialOptions,
    material: Annotated[Any | None, ChoiceOf("slatprep.particles.motion:CLASSES")] = None,
    young: Above0 | None = None,
    density: Above0 | None = None,
    out: NewFolder,
    picture: NewFile | None = None,
    axes: Annotated[Any | None, ChoiceOf("slatprep.particles.read:Axes")] = None,
    stretch: bool = False,
    particles: Annotated[int, click.IntRange(min=4, max=256)] = 32,
    motion: MotionOptions,
) -> None:
    """Simulate an object of a store, or a predicted one, and move its Gaussians.

    Particles fill the object and take the materials of its voxels; Newton's
    material point method moves them on a CPU or a GPU. Gaussians are carried by
    the particles around them: positions and rotations follow, all other
    attributes stay. Needs Newton: pip install 'slatprep[simulate]'.

    Parameters
    ----------
    gaussians : FILE.ply
        PLY of Gaussians of the object, as TRELLIS, SAM 3D Objects or PhysGaussian save them.
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
        Also draw the frames: an animation (gif, webp) or a strip of five (png).
    axes
        Axes of the Gaussians. [default: those that fit]
    stretch
        Let the scales of Gaussians follow the deformation too.
    particles
        Particles along each axis of the cube.

    Example
    -------
    slatprep simulate --store data/demo.zarr --asset 5f61cc --out frames --picture fall.gif
    slatprep simulate --gaussians cup.ply --prediction out/cup.npz --ranges pixie --out frames
    slatprep simulate --store data/demo.zarr --asset 5f61cc --out frames --wind 8
    """
    from slatprep.particles import motion as work
    from slatprep.particles.picture import require_picture

    if picture is not None:
        require_picture(picture)
    scene: Scene = work.prepare(
        source.field("grid" if source.asset is not None else "slat"),
        work.cells_of(source.store, source.asset),
        gaussians,
        axes,
        particles,
        work.Override(material, young, density),
    )
    for note in scene.notes:
        output.note(note)
    begin, how = time.perf_counter(), work.Motion(**vars(motion))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        moved = work.run(scene, how)
    for warning in told:
        output.note(str(warning.message))
    computed = time.perf_counter() - begin
    with output.progress("simulate") as progress:
        count = work.write_frames(Path(out), scene, moved, how, picture, stretch, progress=progress)
    counts = {
        "particles": len(scene.positions),
        "gaussians": len(scene.vertices),
        "frames": count,
        "seconds": computed,
    }
    output.counted(f"Frames in {out}", counts, path=out)
