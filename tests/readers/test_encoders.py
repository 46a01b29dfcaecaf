"""Which encoder made latents, and whether they look standardised."""

import json
from dataclasses import replace

import numpy as np
import pytest

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import SlatSource
from slatprep.readers import read_latents, read_slat
from slatprep.readers.adapters import latent_adapter
from slatprep.readers.contents import latent_space, look_standardised, resolve_latents, tell_alone
from slatprep.records import FEATS_MEAN, FEATS_STD, TRELLIS, LatentMoments, LatentSpace


def moments_of(feats: np.ndarray) -> LatentMoments:
    return LatentMoments(tuple(feats.mean(axis=0).tolist()), tuple(feats.std(axis=0).tolist()))


@pytest.mark.parametrize("seed", range(20))
def test_raw_and_standardised_latents_are_told_apart(seed):
    rng = np.random.default_rng(seed)
    # One asset's channels spread less than a dataset's, and about a mean of its own. Those of most
    # are told apart, and those that are asked about, as they lie far off, are not mistaken.
    for spread, off, sure in (
        (1.0, 0.4, True),
        (0.6, 0.4, True),
        (rng.uniform(0.3, 1.1), 0.6, False),
    ):
        z = rng.normal(size=(500, 8)) * spread + rng.normal(scale=off, size=8)
        raw = z * np.array(FEATS_STD) + np.array(FEATS_MEAN)
        for feats, right in ((z, True), (raw, False)):
            moments = moments_of(feats)
            if sure or tell_alone(moments, TRELLIS):
                assert look_standardised(moments, TRELLIS) is right


def test_trellis_2_has_the_moments_that_microsoft_publishes():
    for name, mean, std in (
        ("trellis2", 0.781296, 5.972266),
        ("trellis2-512", 0.781296, 5.972266),
        ("trellis2-pbr", 3.501659, 2.665652),
        ("trellis2-pbr-512", 3.501659, 2.665652),
    ):
        adapter = latent_adapter(name)
        assert adapter is not None
        space = adapter.space
        assert (space.encoder, space.channels, len(space.std)) == (name, 32, 32)
        assert (space.mean[0], space.std[0]) == (mean, std)
        folder = f"{'pbr' if 'pbr' in name else 'shape'}_latents/*_{space.resolution * 16}/"
        assert f"{folder}{{id}}.npz" in (getattr(adapter, "patterns", ()) or SlatSource.pattern)


def test_unpublished_moments_are_those_of_all_voxels_of_the_dataset():
    rng = np.random.default_rng(1)
    parts = [rng.normal(size=(n, 4)) * 3 + shift for n, shift in ((100, 5.0), (700, -2.0))]
    space = resolve_latents(
        LatentSpace("mine", 4, 64), "auto", [(len(part), moments_of(part)) for part in parts]
    )
    every = np.concatenate(parts)
    assert not space.standardised
    np.testing.assert_allclose(space.mean, every.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(space.std, every.std(axis=0), rtol=1e-12)
    standardised = space.standardise(every.astype(np.float32))
    np.testing.assert_allclose(standardised.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(standardised.std(axis=0), 1, atol=1e-6)


def test_what_is_standardised_is_not_standardised_again_and_can_be_undone():
    feats = np.random.default_rng(2).normal(size=(50, 8)).astype(np.float32)
    done = replace(TRELLIS, standardised=True)
    np.testing.assert_array_equal(done.standardise(feats), feats)
    np.testing.assert_allclose(TRELLIS.standardise(done.as_encoded(feats)), feats, atol=1e-6)
    np.testing.assert_array_equal(TRELLIS.as_encoded(feats), feats)


def test_the_reader_wants_the_encoder_s_channels(make_pair):
    pair = make_pair(
        coords=np.array([[1, 2, 3], [4, 5, 6]], np.uint8), feats=np.ones((2, 32), np.float32)
    )
    with pytest.raises(InputError, match=r"\(2, 32\).*8\).*slat\.encoder: trellis"):
        read_latents(pair)
    wide = LatentSpace("trellis2", 32, 64)
    contents = replace(pair.roots.contents, latents=wide)
    pair = replace(pair, roots=replace(pair.roots, contents=contents))
    assert read_latents(pair).feats.shape == (2, 32)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "channels"),
        ('{"encoder": "a", "channels": 2, "resolution": 64, "mean": [1]}', "each of 2 channels"),
        ('{"encoder": "a", "channels": 1, "resolution": 64, "mean": [1], "std": [0]}', "above 0"),
        ('{"encoder": "a", "channels": 2, "resolution": 1}', r"mine\.json.*resolution"),
        ('{"encoder": "a", "channels": 2, "resolution": 257}', r"mine\.json.*resolution"),
        ("nonsense", "cannot|Expecting|describes"),
    ],
)
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
