"""The decoder against what it must not depend on, and a dense reference."""

import pytest
import torch
from torch import Tensor

from slatprep.learn.decoder import (
    SIZES,
    DecoderSize,
    PhysicsDecoder,
    WindowAttention,
    embed_position,
    make_decoder,
    partition,
)

TINY = DecoderSize(24, 2, 2)


def voxels(count: int, seed: int, batch: int = 0, extent: int = 64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randperm(extent**3, generator=generator)[:count]
    axes = (flat // extent**2, flat // extent % extent, flat % extent)
    coords = torch.stack([torch.full((count,), batch), *axes], dim=1).int()
    return coords, torch.randn(count, 8, generator=generator)


@pytest.fixture
def model() -> PhysicsDecoder:
    torch.manual_seed(0)
    made = PhysicsDecoder(TINY)
    # The heads begin at 0, which would hide everything before them.
    for head in (made.regression, made.classification):
        torch.nn.init.xavier_uniform_(head.weight)
    return made


@pytest.mark.parametrize(("size", "millions"), [("small", 0.20), ("medium", 1.19), ("large", 6.32)])
def test_parameters_are_as_many_as_the_paper_says(size, millions):
    parameters = sum(p.numel() for p in make_decoder(size).parameters())
    assert parameters / 1e6 == pytest.approx(millions, abs=0.0051)
    assert set(SIZES) >= {"small", "medium", "large"}


@pytest.mark.parametrize("shift", [0, 4])
def test_attention_equals_a_dense_reference(shift):
    torch.manual_seed(0)
    attention = WindowAttention(24, 2)
    coords, _ = voxels(300, 3, extent=24)
    coords[150:, 0] = 1
    hidden = torch.randn(300, 24)
    sparse = attention(hidden, partition(coords, 8, shift))
    # Every pair, then a softmax over those that share batch and window.
    place = [(int(b), *((int(i) + shift) // 8 for i in voxel)) for b, *voxel in coords]
    same = torch.tensor([[a == b for b in place] for a in place])
    heads = []
    for q, k, v in zip(
        *(part.split(12, dim=1) for part in attention.qkv(hidden).split(24, dim=1)), strict=True
    ):
        scores = (q @ k.T) / 12**0.5
        heads.append(scores.masked_fill(~same, -torch.inf).softmax(dim=1) @ v)
    torch.testing.assert_close(sparse, attention.out(torch.cat(heads, dim=1)), rtol=0, atol=1e-5)


def test_shifted_windows_carry_news_further(model):
    # 7 and 8 are in different windows of the first block and share one of the second.
    coords = torch.tensor([[0, 7, 0, 0], [0, 8, 0, 0], [0, 40, 40, 40]], dtype=torch.int32)
    feats = torch.zeros(3, 8, requires_grad=True)
    model(coords, feats).properties[0].sum().backward()
    reached = feats.grad.abs().sum(dim=1) > 0
    assert reached.tolist() == [True, True, False]


@pytest.mark.parametrize("channels", [24, 64])
def test_positions_are_told_apart(channels):
    axis = torch.arange(64)
    for k in range(3):
        coords = torch.zeros(64, 3, dtype=torch.int32)
        coords[:, k] = axis
        waves = embed_position(coords, channels)
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
