"""Every form and every fault of a SLAT; which encoder made it, and if it is standardised."""

import hashlib
import json
import os
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.raw_sources import COORDS, FEATS, changed

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import SlatSource
from slatprep.readers import read_latents, read_slat
from slatprep.readers.contents import latent_space, look_standardised, tell_alone
from slatprep.readers.slat import checked_latents
from slatprep.readers.slat_files import slat_patterns
from slatprep.records import FEATS_MEAN, FEATS_STD, TRELLIS, LatentMoments, LatentSpace, SourceFile
from slatprep.records.encoders import LATENTS

BATCHED = np.concatenate([np.zeros((3, 1), np.int32), COORDS.astype(np.int32)], axis=1)


def hdf5_pair(pair, group="", **datasets):
    """Write datasets into an HDF5 file, at the top or in a group, and point the pair at it."""
    path = pair.slat.with_name("a.h5")
    with h5py.File(path, "a") as file:
        holder = file.require_group(group) if group else file
        for name, value in datasets.items():
            if isinstance(value, dict):
                holder.create_dataset(name, **value)
            elif isinstance(value, h5py.VirtualLayout):
                holder.create_virtual_dataset(name, value)
            else:
                holder[name] = value
    return replace(pair, slat=path, slat_group=group)


def check(latents):
    assert latents.coords.dtype == np.uint8
    assert latents.feats.dtype == np.float32
    np.testing.assert_array_equal(latents.coords, COORDS)
    np.testing.assert_array_equal(latents.feats, FEATS)


FORMS = {
    "as they are": {},
    "of a batch": {"coords": BATCHED},
    **{f"coords {dtype}": {"coords": COORDS.astype(dtype)} for dtype in ("int32", "int64", ">i2")},
    "in Fortran's order": {"coords": np.asfortranarray(BATCHED), "feats": np.asfortranarray(FEATS)},
    # Eighths are exact in each of these.
    **{f"feats {dtype}": {"feats": FEATS.astype(dtype)} for dtype in ("float16", ">f4", "float64")},
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_read_alike(make_pair, form):
    arrays, pair = {"coords": COORDS, "feats": FEATS, "extra": "kept", **FORMS[form]}, make_pair()
    np.savez(pair.slat, **arrays)
    packed = replace(pair, slat=pair.slat.with_name("b.npz"))
    np.savez_compressed(packed.slat, **arrays)
    groups = [hdf5_pair(pair, group, **arrays) for group in ("", "a", "slats/a")]
    rounded = ("feats: float64 rounded to float32",) if form == "feats float64" else ()
    for one in (pair, packed, *groups):
        latents, data = read_latents(one), one.slat.read_bytes()
        check(latents)
        assert latents.warnings == rounded
        source = SourceFile("slat", one.slat.name, len(data), hashlib.sha256(data).hexdigest())
        assert latents.sources == (source,)


@pytest.mark.parametrize("options", [
    {"compression": "gzip"},
    {"fletcher32": True, "chunks": (2, 5)},
    {"compression": "gzip", "shuffle": True, "fletcher32": True, "chunks": (2, 8)},
    {"chunks": (1, 3)},
], ids=str)  # fmt: skip
def test_hdf5_chunks_and_filters(make_pair, options):
    feats = {"data": FEATS, **options}
    check(read_latents(hdf5_pair(make_pair(), "a", coords=COORDS, feats=feats)))


def test_shared_file_is_hashed_again_when_it_changed_in_the_same_tick(make_pair):
    pair = hdf5_pair(make_pair(), "a", coords=COORDS, feats=FEATS)
    before, state = read_latents(pair).sources[0].sha256, pair.slat.stat()
    with h5py.File(pair.slat, "r+") as file:
        file["a/feats"][0, 0] += 1
    os.utime(pair.slat, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert pair.slat.stat().st_size == state.st_size
    assert read_latents(pair).sources[0].sha256 != before


def test_shared_file_is_hashed_once_under_whatever_number_it_is_opened(make_pair, monkeypatch):
    pair = hdf5_pair(make_pair(), "a", coords=COORDS, feats=FEATS)
    before = read_latents(pair).sources
    monkeypatch.setattr(hashlib, "sha256", None)
    with pair.slat.open("rb"):  # which takes the number that the file had
        assert read_latents(pair).sources == before


OUT = "coordinate ({}) in row {} is out of range"
LARGE = changed(FEATS.astype("f8"), ((2, 7), 1e300))
BAD_ARRAYS = [
    ({"coords": COORDS[:, :2]}, "shape (3, 2)", "(N <= 262144, 3)"),
    ({"coords": COORDS.ravel()}, "shape (9,)", "(N <= 262144, 4)"),
    ({"coords": COORDS.astype(np.float32)}, "dtype <f4", "integer"),
    ({"coords": COORDS > 0}, "dtype |b1", "integer"),
    ({"feats": FEATS[:, :7]}, "shape (3, 7)", "(N <= 262144, 8)"),
    ({"feats": FEATS.astype(np.int32)}, "dtype <i4", "floating-point"),
    ({"feats": FEATS[:2]}, "3 rows of coords but 2 of feats", "one latent per voxel"),
    ({"coords": COORDS[:0], "feats": FEATS[:0]}, "SLAT is empty", "at least one voxel"),
    ({"coords": changed(BATCHED, ((2, 0), 1))}, "batch index 1 in row 2", "one asset"),
    ({"coords": changed(BATCHED, ((1, 2), -1))}, OUT.format("63, -1, 2", 1), "0..63"),
    # It would wrap in uint8.
    ({"coords": changed(BATCHED, ((2, 1), 256))}, OUT.format("256, 63, 63", 2), "0..63"),
    ({"coords": changed(COORDS, (2, 0))}, "(0, 0, 0) occurs twice, in rows 0 and 2", "once"),
    ({"feats": changed(FEATS, ((0, 0), -np.inf))}, "feats is -inf in row 0", "finite"),
    ({"feats": LARGE}, "1e+300 in row 2, channel 7", "float32"),
    ({"coords": np.zeros((262145, 3), np.uint8)}, "shape (262145, 3)", "N <= 262144"),
]


@pytest.mark.parametrize(("arrays", "what", "expected"), BAD_ARRAYS, ids=lambda one: str(one)[:25])
def test_bad_arrays(make_pair, arrays, what, expected):
    arrays = {"coords": COORDS, "feats": FEATS, **arrays}
    pair = make_pair(**arrays)
    for one in (pair, hdf5_pair(pair, **arrays), hdf5_pair(pair, "a", **arrays)):
        with pytest.raises(InputError) as caught:
            read_latents(one)
        assert caught.value.path.startswith(str(one.slat))
        assert what in caught.value.fault
        assert expected in caught.value.expected


def cloud(side: int = 64, count: int = 200) -> dict[str, np.ndarray]:
    """Return a SLAT of voxels anywhere on a grid, with latents as TRELLIS's."""
    rng = np.random.default_rng(side)
    cells = np.sort(rng.choice(side**3, count, replace=False))
    coords = np.stack(np.unravel_index(cells, (side,) * 3), axis=1).astype(np.uint8)
    return {"coords": coords, "feats": rng.normal(FEATS_MEAN, FEATS_STD, (count, 8)).astype("f4")}


def test_coordinates_of_a_grid_of_half_the_side_are_told(make_pair):
    (told,) = read_latents(make_pair(**cloud(32))).warnings
    assert told.startswith("unusual places: no coordinate is above 31, as on a grid of 32^3")
    assert "a small object has that" in told and "(a JSON file that describes it)" in told
    cells = cloud(32) | {"feats": np.tile(cloud()["feats"], 4)}
    pair = make_pair(**cells)
    told = read_slat(pair.slat, pair.roots.slat, "", LATENTS["trellis2-pbr"]).warnings[0]
    assert "(trellis2-512, trellis2-pbr-512)" in told
    assert read_latents(make_pair(**cloud(64))).warnings == ()
    assert read_latents(make_pair(**cloud(32, count=20))).warnings == ()


def test_latents_that_no_encoder_gives_are_told(make_pair):
    whole = cloud()
    feats = whole["feats"]
    for odd, said in (
        (0 * feats, "feats are the same in all 200 rows"),
        (0 * feats + feats[0], "feats are the same in all 200 rows"),
        (changed(feats, ((5, 2), -65504)), "feats reach 6.55e+04"),
        (changed(feats, (np.s_[:, [2, 7]], 1.5)), "channel 2, 7 of feats is the same in all rows"),
        (changed(feats, (np.s_[:30], 0)), "feats are 0 in 15% of the rows"),
    ):
        (told,) = read_latents(make_pair(**whole | {"feats": odd})).warnings
        assert told.startswith(f"unusual latents: {said}")
    assert read_latents(make_pair(**whole | {"feats": changed(feats, (3, 0))})).warnings == ()
    few = {name: rows[:20] for name, rows in (whole | {"feats": 0 * feats}).items()}
    assert read_latents(make_pair(**few)).warnings == ()


@pytest.mark.parametrize(("change", "said"), [
    (lambda raw: raw, ""),
    (lambda raw: 0.5 * raw, ""),  # An object whose voxels are much alike.
    (lambda raw: (raw - FEATS_MEAN) / FEATS_STD, ""),  # Once: a build tells.
    (lambda raw: ((raw - FEATS_MEAN) / FEATS_STD - FEATS_MEAN) / FEATS_STD, "feats spread 0.1"),
    (lambda raw: raw * FEATS_STD + FEATS_MEAN, "feats spread 2"),
    (lambda raw: 100 * raw, "feats spread 1"),
])  # fmt: skip
def test_latents_that_were_scaled_twice_are_told(change, said, make_pair):
    whole = cloud(count=2000)
    feats = change(whole["feats"]).astype(np.float32)
    read = read_latents(make_pair(**whole | {"feats": feats}))
    told = [text for text in read.warnings if "unusual latents" in text]
    assert len(told) == bool(said) and said in "".join(told)


@pytest.mark.parametrize("name", LATENTS)
def test_latents_of_known_encoders_are_usual_raw_and_standardised(name):
    space = LATENTS[name]
    rng, whole = np.random.default_rng(1), cloud(space.resolution, 2000)
    scaled = rng.normal(0, 0.8, (2000, space.channels))
    for feats in (scaled, scaled * np.array(space.std) + np.array(space.mean)):
        read = checked_latents(whole["coords"], feats.astype(np.float32), "any", space=space)
        assert not [text for text in read.warnings if "unusual" in text]


def test_missing_array_and_group(make_pair):
    pair = make_pair()
    for missing, arrays in (("feats", {"coords": COORDS}), ("coords", {"feats": FEATS})):
        np.savez(pair.slat, **arrays)
        with pytest.raises(InputError, match=f"has no array '{missing}'"):
            read_latents(pair)
        told = f"has no dataset '{missing}'.* datasets coords, feats"
        with pytest.raises(InputError, match=told):
            read_latents(hdf5_pair(pair, missing, **arrays))
    with pytest.raises(InputError, match="has no group 'b'"):
        read_latents(replace(hdf5_pair(pair), slat_group="b"))


def test_npz_that_wants_pickle_is_refused(make_pair):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was run",))

    pair = make_pair()
    np.savez(pair.slat, coords=COORDS, feats=np.array([Trap()], dtype=object))
    with pytest.raises(InputError, match=r"a\.npz \[feats\].*pickle"):
        read_latents(pair)


def test_hdf5_whose_values_lie_elsewhere_or_nowhere_is_refused(make_pair, tmp_path):
    secret, raw = str(tmp_path / "secret.h5"), tmp_path / "secret.bin"
    with h5py.File(secret, "w") as file:
        file["feats"] = FEATS
    raw.write_bytes(FEATS.tobytes())
    virtual = h5py.VirtualLayout((3, 8), np.float32)
    virtual[:] = h5py.VirtualSource(secret, "feats", (3, 8))
    empty = {"shape": (3, 8), "dtype": np.float32}
    cases = [
        (h5py.SoftLink("/0/coords"), "soft or external link"),
        (h5py.ExternalLink(secret, "feats"), "soft or external link"),
        (empty | {"external": [(str(raw), 0, 96)]}, "keeps its values in another file"),
        (virtual, "virtual dataset"),
        # HDF5 would read zeros, which are latents as good as any.
        (empty, "holds 0 of 96 bytes"),
        (empty | {"chunks": (2, 8)}, "its 0 chunks are not the 2"),
        ({"data": FEATS, "compression": "lzf"}, r"uses HDF5 filters \[32000\].*h5repack"),
    ]
    for number, (feats, fault) in enumerate(cases):
        pair = hdf5_pair(make_pair(), str(number), coords=COORDS, feats=feats)
        with pytest.raises(InputError, match=rf"\[{number}/feats\]: .*{fault}"):
            read_latents(pair)


def test_hdf5_chunk_that_fails_its_checksum_is_refused(make_pair):
    feats = {"data": FEATS, "fletcher32": True, "chunks": (3, 8)}
    pair = hdf5_pair(make_pair(), coords=COORDS, feats=feats)
    data = bytearray(pair.slat.read_bytes())
    data[data.index(FEATS.tobytes())] ^= 1
    pair.slat.write_bytes(data)
    with pytest.raises(InputError, match="checksum"):
        read_latents(pair)


@pytest.mark.parametrize("seed", range(20))
def test_raw_and_standardised_latents_are_told_apart(seed):
    rng = np.random.default_rng(seed)
    # Most assets' are told apart, and those that are asked about, far off, are not mistaken.
    for spread, off in ((1.0, 0.4), (0.6, 0.4), (rng.uniform(0.3, 1.1), 0.6)):
        z = rng.normal(size=(500, 8)) * spread + rng.normal(scale=off, size=8)
        raw = z * np.array(FEATS_STD) + np.array(FEATS_MEAN)
        for feats, right in ((z, True), (raw, False)):
            moments = LatentMoments(tuple(feats.mean(axis=0)), tuple(feats.std(axis=0)))
            if off == 0.4 or tell_alone(moments, TRELLIS):
                assert look_standardised(moments, TRELLIS) is right


def test_trellis_2_has_the_moments_that_microsoft_publishes(tmp_path):
    for name in ("trellis2", "trellis2-512", "trellis2-pbr", "trellis2-pbr-512"):
        source = SlatSource(tmp_path, encoder=name)
        space = latent_space(source)
        assert (space.encoder, space.channels, len(space.std)) == (name, 32, 32)
        first = (3.501659, 2.665652) if "pbr" in name else (0.781296, 5.972266)
        assert (space.mean[0], space.std[0]) == first
        folder = f"{'pbr' if 'pbr' in name else 'shape'}_latents/*_{space.resolution * 16}/"
        assert f"{folder}{{id}}.npz" in slat_patterns(source)


@pytest.mark.parametrize(("text", "said"), [
    ("{}", "channels"),
    ('{"encoder": "a", "channels": 2, "resolution": 64, "mean": [1]}', "each of 2 channels"),
    ('{"encoder": "a", "channels": 1, "resolution": 64, "mean": [1], "std": [0]}', "above 0"),
    ('{"encoder": "a", "channels": 2, "resolution": 1}', r"mine\.json.*resolution"),
    ('{"encoder": "a", "channels": 2, "resolution": 257}', r"mine\.json.*resolution"),
    ("nonsense", "cannot|Expecting|describes"),
])  # fmt: skip
def test_a_file_that_describes_no_encoder(tmp_path, text, said):
    path = tmp_path / "mine.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        latent_space(SlatSource(tmp_path, encoder=str(path)))
    with pytest.raises(ConfigError, match=r"'trelis'.*trellis, .*JSON file"):
        latent_space(SlatSource(tmp_path, encoder="trelis"))


def test_voxels_are_of_the_grid_of_an_encoder_of_one_s_own(tmp_path):
    about = {"encoder": "mine", "channels": 2, "resolution": 32, "mean": [1, 2], "std": [3, 4]}
    (tmp_path / "mine.json").write_text(json.dumps(about))
    source = SlatSource(tmp_path, encoder=str(tmp_path / "mine.json"), standardised="yes")
    space = latent_space(source)
    assert space == LatentSpace("mine", 2, 32, (1.0, 2.0), (3.0, 4.0), True)
    coords, feats = np.array([[0, 15, 31]], np.uint8), np.ones((1, 2), np.float32)
    np.savez(tmp_path / "a.npz", coords=coords, feats=feats)
    read = read_slat(tmp_path / "a.npz", tmp_path, space=space)
    np.testing.assert_allclose(read.centres, [[-31 / 64, -1 / 64, 31 / 64]])
    np.savez(tmp_path / "a.npz", coords=coords + 1, feats=feats)
    with pytest.raises(InputError, match=r"\(1, 16, 32\).*0\.\.31.*slat\.encoder: mine"):
        read_slat(tmp_path / "a.npz", tmp_path, space=space)
