"""The loader: splits, batches, workers, symmetries. The decoder against a dense reference."""

import hashlib
import itertools
import re
import subprocess
import sys
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import zarr
from hypothesis import given
from hypothesis import strategies as st
from support.made_store import rewrite
from torch import Tensor
from torch.utils.data import DataLoader

from slatprep import ConfigError, StoreError, learn, open_store
from slatprep.learn import decoder
from slatprep.learn.augment import lattice_symmetries
from slatprep.learn.splits import select_assets
from slatprep.learn.train import TrainParameters
from slatprep.readers.splits import SPLITS, split_objects

THIRDS = learn.Shares(0.4, 0.3, 0.3)


def test_without_pytorch_scores_work_and_the_loader_says_what_to_install():
    script = (
        "import sys; sys.modules['torch'] = None\n"
        "from slatprep.learn import Shares\nimport slatprep.learn.metrics\n"
        "try: from slatprep.learn import SlatDataset\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.startswith("ConfigError"), done.stderr
    assert "pip install 'slatprep[train]'" in done.stdout


@given(st.text(), st.tuples(st.integers(0, 100), st.integers(1, 100), st.integers(1, 100)))
def test_split_is_where_the_hash_falls(object_id, parts):
    total = sum(parts)
    shares = learn.Shares(parts[0] / total, parts[1] / total, 1 - (parts[0] + parts[1]) / total)
    position = int(hashlib.sha256(object_id.encode()).hexdigest()[:16], 16) / 2**64
    edges = np.array([shares.train, shares.train + shares.val])
    expected = ("train", "val", "test")[int(np.searchsorted(edges, position, side="right"))]
    if np.abs(edges - position).min() > 1e-9:
        assert learn.split_of(object_id, shares) == expected


def test_filters(learn_store):
    store = open_store(learn_store)
    good = select_assets(store, verdicts=("good",))
    assert learn.SlatDataset(learn_store, verdicts="good").indices.tolist() == good.tolist()
    assert TrainParameters(verdicts="all").verdicts == ("good", "doubtful", "failed")
    with pytest.raises(ConfigError, match="verdict is 'fine'; expected one of good"):
        learn.SlatDataset(store, verdicts="fine")
    assert good.tolist() == np.flatnonzero(store.column("verdict").astype(str) == "good").tolist()
    limit = float(np.median(store.column("ambiguity")))
    kept = select_assets(store, max_ambiguity=limit)
    assert kept.tolist() == np.flatnonzero(store.column("ambiguity") <= limit).tolist()
    with pytest.raises(ConfigError, match="expected one of good, doubtful, failed"):
        select_assets(store, verdicts=("fine",))
    with pytest.raises(ConfigError, match="add up to 1"):
        learn.Shares(0.5, 0.1, 0.1)
    with pytest.raises(ConfigError, match="no asset"):
        learn.SlatDataset(store, "train", shares=learn.Shares(0.0, 0.0, 1.0))


def test_failed_assets_are_left_out_unless_asked_for_and_unlabelled_ones_always(learn_copy):
    for row, verdict in ((1, "failed"), (4, "doubtful"), (7, "failed")):
        rewrite(learn_copy, "asset/verdict", row, verdict)
    dataset = learn.SlatDataset(learn_copy)
    assert dataset.indices.tolist() == [0, 2, 3, 4, 5, 6, 8]
    assert f"{learn_copy}, split all: 7 assets, 2 left out by verdict" in repr(dataset)
    assert dataset[-1].asset_id == dataset[6].asset_id == dataset.asset_ids[-1]
    for number in (7, -8):
        with pytest.raises(IndexError):
            dataset[number]
    for everything in ("all", (), ("all", "good")):
        assert len(learn.SlatDataset(learn_copy, verdicts=everything)) == 9
    parts = [learn.SlatDataset(learn_copy, split, shares=THIRDS) for split in SPLITS]
    left = [int(re.search(r"(\d+) left out", repr(part))[1]) for part in parts]
    assert sum(map(len, parts)) == 7 and sum(left) == 2
    assert next(iter(learn.SlatLoader(learn_copy, 9))).asset_ids == dataset.asset_ids
    rewrite(learn_copy, "asset/valid_share", 0, 0.0)
    labelled = select_assets(open_store(learn_copy))
    assert labelled.tolist() == list(range(1, 9))


def test_batch_is_what_zarr_reads(learn_store):
    dataset = learn.SlatDataset(learn_store)
    batch = learn.collate([dataset[k] for k in range(3)])
    assert next(iter(learn.SlatLoader(str(learn_store), 3))).asset_ids == batch.asset_ids
    root = zarr.open_group(learn_store, mode="r")
    offset = np.asarray(root["asset/offset"])
    rows = np.s_[: offset[3]]
    assert batch.asset_ids == np.asarray(root["asset/id"])[:3].tolist()
    assert batch.coords.dtype == torch.int32
    assert batch.coords[:, 0].tolist() == np.repeat(range(3), np.diff(offset[:4])).tolist()
    np.testing.assert_array_equal(batch.coords[:, 1:], root["voxel/coords"][rows])
    feats = (root["voxel/feats"][rows] - np.array(learn.FEATS_MEAN)) / np.array(learn.FEATS_STD)
    np.testing.assert_allclose(batch.feats, feats, rtol=1e-5, atol=1e-6)
    valid = root["voxel/valid"][rows]
    np.testing.assert_array_equal(batch.valid, valid)
    np.testing.assert_array_equal(batch.properties, np.nan_to_num(root["voxel/properties"][rows]))
    material = np.where(valid, root["voxel/material"][rows].astype(int), learn.IGNORED)
    np.testing.assert_array_equal(batch.material, material)
    spans = list(itertools.pairwise(offset[:4].tolist()))
    assert [(s.start, s.stop) for s in batch.layout] == spans


def epochs(loader: learn.SlatLoader, *chosen: int) -> list[learn.SparseBatch]:
    batches = []
    for epoch in chosen:
        loader.set_epoch(epoch)
        batches += list(loader)
    return batches


# Each epoch has workers of its own, and those that are spawned import PyTorch.
@pytest.mark.parametrize(("workers", "method", "first"), [(2, "fork", 0), (1, "spawn", 1)])
def test_workers_change_nothing(learn_store, workers, method, first):
    dataset = learn.SlatDataset(learn_store, augmentation="all", seed=3)
    alone = epochs(learn.SlatLoader(dataset, 2, shuffle=True), 0, 1)
    with_workers = learn.SlatLoader(dataset, 2, shuffle=True, workers=workers, start_method=method)
    shared = epochs(with_workers, *range(first, 2))
    for ours, theirs in zip(alone[5 * first :], shared, strict=True):
        assert ours.asset_ids == theirs.asset_ids
        for name in ("coords", "feats", "properties", "material", "valid"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    one, other = ([i for b in half for i in b.asset_ids] for half in (alone[:5], alone[5:]))
    assert sorted(one) == sorted(other) == dataset.asset_ids
    assert one != other


def test_no_worker_reads_another_store_at_the_same_path(learn_copy):
    """The same assets, whose rows an update has in another order."""
    loader = learn.SlatLoader(learn.SlatDataset(learn_copy), 2, workers=1, start_method="spawn")
    rewrite(learn_copy, "asset/id", slice(2), loader.dataset.asset_ids[1::-1])
    with pytest.raises(StoreError, match="was the store replaced"):
        list(loader)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_damaged_file_is_the_same_error_in_a_worker(learn_copy, workers):
    loader = learn.SlatLoader(learn.SlatDataset(learn_copy), 2, workers=workers)
    (learn_copy / "voxel/feats/c/0/0").write_bytes(b"")
    with pytest.raises(StoreError, match=f"{learn_copy}/voxel/feats/c/0/0: has no sound index"):
        list(loader)


def test_a_plain_loader_augments_each_epoch_anew(learn_store):
    loader = learn.SlatLoader(learn.SlatDataset(learn_store, augmentation="all", seed=3), 3)
    dataset = learn.SlatDataset(learn_store, augmentation="all", seed=3)
    plain = DataLoader(dataset, 3, collate_fn=learn.collate, num_workers=2)
    found = []
    for epoch, known in enumerate((epochs(loader, 0), epochs(loader, 1))):
        dataset.set_epoch(epoch)
        found.append([batch.coords for batch in plain])
        assert all(map(torch.equal, found[-1], [batch.coords for batch in known]))
    assert not all(map(torch.equal, *found))


def test_each_pass_of_a_loader_is_the_next_epoch(learn_store):
    dataset = learn.SlatDataset(learn_store, augmentation="all", seed=3)
    loader = learn.SlatLoader(dataset, 3, shuffle=True)
    known = [[batch.coords for batch in epochs(loader, epoch)] for epoch in (0, 1, 5, 6)]
    loader.set_epoch(0)
    passes = [[batch.coords for batch in loader] for _ in range(2)]
    loader.set_epoch(5, 1)  # Only the next pass lacks the first batch.
    passes += [known[2][:1] + [batch.coords for batch in loader]]
    passes += [[batch.coords for batch in loader]]
    for own, expected in zip(passes, known, strict=True):
        assert all(map(torch.equal, own, expected)) and len(own) == len(loader)
    with pytest.raises(ConfigError, match="batches to skip: -1"):
        loader.set_epoch(5, -1)


@pytest.mark.parametrize(("name", "value", "expected"), [
    ("min_confidence", 90, "0"),
    ("min_confidence", np.nan, "0"),
    ("seed", -1, "0"),
    *(("augmentation", kind, "one of none, upright, all") for kind in (None, "Upright", "al")),
])  # fmt: skip
def test_what_no_dataset_can_be_given_is_refused(learn_store, name, value, expected):
    with pytest.raises(ConfigError, match=f"{name} is .*; expected {expected}"):
        learn.SlatDataset(learn_store, **{name: value})


def test_symmetries_are_the_groups_they_should_be():
    for kind, size in (("none", 1), ("upright", 8), ("all", 48)):
        matrices = lattice_symmetries(kind)
        known = {m.tobytes() for m in matrices}
        assert len(known) == len(matrices) == size
        assert np.array_equal(matrices[0], np.eye(3))
        assert all((a @ b).tobytes() in known for a in matrices for b in matrices)
        assert all(np.array_equal(m @ m.T, np.eye(3)) for m in matrices)


def test_augmentation_moves_coordinates_and_nothing_else(learn_store):
    plain, moved = learn.SlatDataset(learn_store), 0
    turned = learn.SlatDataset(learn_store, augmentation="all", seed=1)
    for k in range(len(plain)):
        for name in ("feats", "properties", "material", "valid"):
            assert torch.equal(getattr(plain[k], name), getattr(turned[k], name))
        moved += not torch.equal(plain[k].coords, turned[k].coords)
        # Voxels stay as far from one another as they were, all of them.
        a, b = (item.coords[::7].double() for item in (plain[k], turned[k]))
        assert torch.equal(torch.cdist(a, a).round(decimals=6), torch.cdist(b, b).round(decimals=6))
    assert moved > len(plain) // 2


def test_latents_of_another_grid_are_moved_about_its_own_middle(learn_store, monkeypatch):
    given = Mock(side_effect=lambda coords, *_: coords)
    monkeypatch.setattr("slatprep.learn.dataset.move", given)
    dataset = learn.SlatDataset(learn_store, augmentation="all")
    monkeypatch.setattr(dataset, "_latents", replace(dataset._latents, resolution=32))
    assert len(dataset[0].coords)
    assert given.call_args.args[2:] == (32,)


@given(st.sets(st.text(min_size=1), min_size=1, max_size=12))
def test_no_split_is_empty_where_there_are_as_many_objects(objects):
    splits = split_objects(objects)
    assert splits.keys() == objects
    assert len(set(splits.values())) == min(len(objects), 3)
    by_hash = {object_id: learn.split_of(object_id) for object_id in objects}
    if len(set(by_hash.values())) == 3:
        assert splits == by_hash
    assert "val" not in split_objects(objects, learn.Shares(0.5, 0.0, 0.5)).values()


def test_splits_part_the_store_keep_views_together_and_do_not_depend_on_filters(learn_store):
    store = open_store(learn_store)
    ambiguity = np.sort(store.column("ambiguity"))
    views = {store.find("h.front"), store.find("h.side")}
    for shares in (THIRDS, learn.Shares(), learn.Shares(0.02, 0.96, 0.02)):
        whole = {s: select_assets(store, s, shares=shares).tolist() for s in SPLITS}
        rows = sorted(itertools.chain(*whole.values()))
        assert all(whole.values()) and rows == [*range(len(store))]
        assert [len(views & set(part)) for part in whole.values()].count(2) == 1
        for limit, split in itertools.product((ambiguity[0], ambiguity[4]), SPLITS):
            some = select_assets(store, split, shares=shares, max_ambiguity=float(limit))
            assert set(some) <= set(whole[split])


def test_voxels_that_are_not_sure_enough_are_left_out(learn_copy):
    sure = zarr.open_group(learn_copy, mode="r")["voxel/confidence"][:]
    spread = sure * np.random.default_rng(0).uniform(size=len(sure))
    rewrite(learn_copy, "voxel/confidence", slice(None), spread)
    store = open_store(learn_copy)
    spread = np.concatenate([asset.confidence[asset.valid] for asset in store])
    least = float(np.median(spread))
    assert (spread >= least).any() and (spread < least).any()
    everything, sure = learn.SlatDataset(store), learn.SlatDataset(store, min_confidence=least)
    for number, asset_id in enumerate(sure.asset_ids):
        asset, item, whole = store.asset(asset_id), sure[number], everything[number]
        kept = asset.valid & (asset.confidence >= least)
        np.testing.assert_array_equal(item.valid.numpy(), kept)
        np.testing.assert_array_equal(whole.valid.numpy(), asset.valid)
        np.testing.assert_array_equal(item.confidence.numpy(), np.where(kept, asset.confidence, 0))
        np.testing.assert_array_equal(item.material.numpy() != learn.IGNORED, kept)
        assert not item.properties.numpy()[~kept].any()


def voxels(count: int, seed: int, extent: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randperm(extent**3, generator=generator)[:count]
    axes = (flat // extent**2, flat // extent % extent, flat % extent)
    coords = torch.stack([torch.zeros_like(flat), *axes], dim=1).int()
    return coords, torch.randn(count, 8, generator=generator)


@pytest.fixture
def model() -> decoder.PhysicsDecoder:
    torch.manual_seed(0)
    made = decoder.PhysicsDecoder(decoder.SIZES["tiny"])
    # The heads begin at 0, which would hide everything before them.
    for head in (made.regression, made.classification):
        torch.nn.init.xavier_uniform_(head.weight)
    return made


@pytest.mark.parametrize(("size", "millions"), [("small", 0.20), ("medium", 1.19), ("large", 6.32)])
def test_parameters_are_as_many_as_the_paper_says(size, millions):
    parameters = sum(p.numel() for p in decoder.make_decoder(size).parameters())
    assert parameters / 1e6 == pytest.approx(millions, abs=0.0051)
    assert set(decoder.SIZES) >= {"small", "medium", "large"}


def test_no_attention_compiles_a_plan_for_each_shape(monkeypatch):
    # As cuDNN's does: windows have hundreds of shapes, and each plan takes 0.02 s.
    usual, compiles = decoder.functional.scaled_dot_product_attention, []

    def watched(*args: Any, **kwargs: Any) -> Tensor:
        compiles.append(torch.backends.cuda.cudnn_sdp_enabled())
        return usual(*args, **kwargs)

    monkeypatch.setattr(decoder.functional, "scaled_dot_product_attention", watched)
    attention = decoder.WindowAttention(24, 2).to("meta")  # A device that is no CPU.
    mask = torch.ones(3, 5, dtype=torch.bool, device="meta")
    places = torch.arange(15, device="meta")
    windows = decoder.Windows(places, [mask], places)
    assert attention(torch.zeros(15, 24, device="meta"), windows).shape == (15, 24)
    assert compiles == [False]


@pytest.mark.parametrize("shift", [0, 4])
def test_attention_equals_a_dense_reference(shift):
    torch.manual_seed(0)
    attention = decoder.WindowAttention(24, 2)
    coords, _ = voxels(300, 3, extent=24)
    coords[150:, 0] = 1
    hidden = torch.randn(300, 24)
    sparse = attention(hidden, decoder.partition(coords, shift))
    # Every pair, then a softmax over those that share batch and window.
    place = [(int(b), *((int(i) + shift) // 8 for i in voxel)) for b, *voxel in coords]
    same = torch.tensor([[a == b for b in place] for a in place])
    heads = []
    parts = (part.split(12, dim=1) for part in attention.qkv(hidden).split(24, dim=1))
    for q, k, v in zip(*parts, strict=True):
        scores = (q @ k.T) / 12**0.5
        heads.append(scores.masked_fill(~same, -torch.inf).softmax(dim=1) @ v)
    torch.testing.assert_close(sparse, attention.out(torch.cat(heads, dim=1)), rtol=0, atol=1e-5)


def test_shifted_windows_carry_news_further(model):
    # 7 and 8 are in different windows of the first block and share one of the second.
    coords = torch.tensor([[0, 7, 0, 0], [0, 8, 0, 0], [0, 40, 40, 40]], dtype=torch.int32)
    feats = torch.zeros(3, 8, requires_grad=True)
    model(coords, feats).properties[0].sum().backward()
    assert (feats.grad.abs().sum(dim=1) > 0).tolist() == [True, True, False]


@pytest.mark.parametrize("channels", [24, 64])
def test_positions_are_told_apart(channels):
    axis = torch.arange(64)
    for k in range(3):
        coords = torch.zeros(64, 3, dtype=torch.int32)
        coords[:, k] = axis
        waves = decoder.embed_position(coords, channels)
        assert waves.shape == (64, channels)
        assert (torch.cdist(waves, waves) + torch.eye(64)).min() > 0.1


def test_gradients_are_finite_in_mixed_precision(model):
    coords, feats = voxels(500, 4, extent=24)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = model(coords, 30 * feats)
        loss = prediction.properties.square().mean() + prediction.logits.logsumexp(1).mean()
    loss.backward()
    assert prediction.properties.dtype == torch.float32
    assert prediction.properties.abs().max() <= 1
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name
