"""The paper's protocol on Open3D, and GICP."""

import sys

import numpy as np
import pytest
from support.shapes import chair, field_of, surface_latents, turned

from slatprep.align import align, engine_versions
from slatprep.align.starts import distinct_starts
from slatprep.api import align_voxels
from slatprep.errors import SlatprepError
from slatprep.geometry.frames import displacement, make_transform, split_transform
from slatprep.parameters import PRESETS, AlignParameters

ENGINES = {"open3d": PRESETS["paper"].align, "small_gicp": AlignParameters(engine="small_gicp")}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("index", [0, 9, 17])
def test_a_quarter_turn_is_found(engine, index):
    rotation = distinct_starts()[index].rotation
    solid = chair()
    latents = surface_latents(turned(solid, rotation))
    alignment = align(field_of(solid), latents, ENGINES[engine])
    assert displacement(alignment.transform, make_transform(rotation), latents.centres) < 0.05
    assert alignment.engine == engine
    assert alignment.model == "rigid"
    assert split_transform(alignment.transform)[2] == pytest.approx(1.0, abs=1e-6)
    assert len(alignment.candidates) == 64
    by_fitness = max(alignment.candidates, key=lambda c: (c.fitness, -c.inlier_rmse))
    turn = by_fitness.index if by_fitness.same_as is None else by_fitness.same_as
    assert turn == distinct_starts()[index].index
    for candidate in alignment.candidates:
        if candidate.same_as is not None:
            twin = alignment.candidates[candidate.same_as]
            assert (candidate.fitness, candidate.inlier_rmse) == (twin.fitness, twin.inlier_rmse)


def test_the_paper_s_protocol_gives_the_same_bits_again():
    solid = chair()
    latents = surface_latents(np.roll(solid, 1, axis=0))
    once, again = (align(field_of(solid), latents, PRESETS["paper"].align) for _ in range(2))
    assert once.transform.tobytes() == again.transform.tobytes()
    assert once.candidates == again.candidates


@pytest.mark.parametrize(
    ("library", "package"), [("libX11.so.6", "libx11-6"), ("libusb-1.0.so.0", "libusb-1.0-0")]
)
def test_an_engine_whose_libraries_are_missing_names_them(library, package, monkeypatch, tmp_path):
    """As Open3D on a system without a desktop."""
    (tmp_path / "open3d").mkdir()
    fault = f"{library}: cannot open shared object file: No such file or directory"
    (tmp_path / "open3d/__init__.py").write_text(f"raise ImportError({fault!r})")
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SlatprepError, match=rf"{library}.* {package}"):
        engine_versions(ENGINES["open3d"])


@pytest.mark.parametrize(("engine", "extra"), [("open3d", "paper"), ("small_gicp", "bench")])
def test_an_engine_that_is_not_installed_names_its_extra(monkeypatch, engine, extra):
    monkeypatch.setitem(sys.modules, engine, None)  # as an import finds a package that is missing
    parameters = ENGINES[engine]
    for call in (
        lambda: engine_versions(parameters),  # what a build asks before its first asset
        lambda: align_voxels([[1, 2, 3]], [[1, 2, 3]], parameters),
    ):
        with pytest.raises(SlatprepError, match=rf"{engine}.*slatprep\[{extra}\]"):
            call()
