"""SLAT-Phys's decoder: a sparse Swin transformer over occupied voxels, in plain PyTorch.

The architecture is that of TRELLIS's sparse Swin decoders. Pre-norm blocks have multi-head
attention within windows of 8^3 voxels, shifted by half a window in every other block (Liu et al.,
"Swin Transformer", ICCV 2021). They have an MLP of four times the width, and layer norms without
parameters. The absolute position has a sinusoidal embedding. With the widths, depths and heads of
SLAT-Phys it has the numbers of parameters that SLAT-Phys states.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from slatprep.records import MAX_LATENT_RESOLUTION, PIXIEVERSE, Contents

WINDOW = 8
"""Edge of an attention window [voxel]."""

_BUCKETS = (8, 16, 32, 48, 64, 96, 128, 192, 256, 384, WINDOW**3)
"""Bounds on the voxels of windows that share one padded attention call."""


@dataclass(frozen=True)
class DecoderSize:
    """Width, number of blocks and of attention heads."""

    channels: int
    blocks: int
    heads: int


SIZES = {
    "small": DecoderSize(64, 4, 4),
    "medium": DecoderSize(128, 6, 8),
    "large": DecoderSize(256, 8, 16),
}
"""The sizes of SLAT-Phys: 0.20, 1.19 and 6.32 million parameters."""


class Prediction(NamedTuple):
    """Predictions for N voxels.

    Attributes
    ----------
    properties : Tensor of float32, shape (N, P)
        Properties in [-1, 1].
    logits : Tensor of float32, shape (N, C)
        Scores of the classes; one column for a store without classes.
    """

    properties: Tensor
    logits: Tensor


class Windows(NamedTuple):
    """Voxels grouped by window; windows with similar numbers of voxels are padded to one length.

    Attributes
    ----------
    rows : Tensor of int64, shape (P,)
        Rows of the voxels, window by window, with padding.
    masks : list of Tensor of bool, shape (W, L)
        For each group of W windows of length L, which entries are not padding.
    back : Tensor of int64, shape (N,)
        Position of each voxel in `rows`.
    """

    rows: Tensor
    masks: list[Tensor]
    back: Tensor


def partition(coords: Tensor, shift: int) -> Windows:
    """Group voxels (N, 4), batch column first and in any order, by window.

    The windows' grid is shifted by `shift` voxels.
    """
    cell = torch.div(coords[:, 1:].long() + shift, WINDOW, rounding_mode="floor")
    across = (MAX_LATENT_RESOLUTION + WINDOW) // WINDOW + 1
    key = ((coords[:, 0].long() * across + cell[:, 0]) * across + cell[:, 1]) * across + cell[:, 2]
    order = torch.argsort(key, stable=True)
    counts = torch.unique_consecutive(key[order], return_counts=True)[1]
    starts = torch.cumsum(counts, 0) - counts
    rows, masks, smallest = [], [], 0
    for limit in _BUCKETS:
        chosen = (counts > smallest) & (counts <= limit)
        smallest = limit
        if bool(chosen.any()):
            place = torch.arange(int(counts[chosen].max()), device=coords.device)
            real = place < counts[chosen, None]
            # Padding repeats a window's first voxel; attention masks it.
            rows.append(order[starts[chosen, None] + place * real].flatten())
            masks.append(real)
    every = torch.cat(rows)
    back = torch.empty_like(order)
    places = torch.cat([mask.flatten() for mask in masks]).nonzero()[:, 0]
    back[every[places]] = places
    return Windows(every, masks, back)


def embed_position(coords: Tensor, channels: int) -> Tensor:
    """Return the sinusoidal embedding (N, channels) of voxel indices (N, 3).

    The frequencies are 10000^(-k / K), k = 0..K-1, for each axis (Vaswani et al., "Attention is all
    you need", 2017); channels beyond a multiple of six are 0.
    """
    count = channels // 6
    steps = torch.arange(count, dtype=torch.float32, device=coords.device) / count
    angles = coords.float()[..., None] * 10000.0**-steps
    waves = torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(1)
    return functional.pad(waves, (0, channels - waves.shape[1]))


class WindowAttention(nn.Module):
    """Multi-head self-attention among the voxels of one window."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, hidden: Tensor, windows: Windows) -> Tensor:
        """Return the attended features, (N, channels)."""
        padded = self.qkv(hidden).index_select(0, windows.rows)
        parts = []
        groups = padded.split([mask.numel() for mask in windows.masks])
        for group, real in zip(groups, windows.masks, strict=True):
            split = group.unflatten(1, (3, self.heads, -1)).unflatten(0, tuple(real.shape))
            q, k, v = split.permute(2, 0, 3, 1, 4)  # each (windows, heads, voxels, width)
            attended = _attend(q, k, v, real[:, None, None, :])
            parts.append(attended.transpose(1, 2).flatten(2).flatten(0, 1))
        result: Tensor = self.out(torch.cat(parts).index_select(0, windows.back))
        return result


def _attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    if q.device.type != "cpu":
        # cuDNN's attention compiles a plan for each new shape, and windows have many: a step
        # takes 1.7 s then, and 0.05 s without.
        with sdpa_kernel([SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]):
            return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    # On a CPU the backward pass of PyTorch's bf16 attention takes twice as long as the rest of
    # a step together; in fp32 it takes a small part of it.
    with torch.autocast("cpu", enabled=False):
        q, k, v = q.float(), k.float(), v.float()
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)


class SwinBlock(nn.Module):
    """Attention and MLP, each after a layer norm and with a residual connection."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels, eps=1e-6, elementwise_affine=False)
        self.attention = WindowAttention(channels, heads)
        self.norm_mlp = nn.LayerNorm(channels, eps=1e-6, elementwise_affine=False)
        self.mlp = nn.Sequential(
            nn.Linear(channels, 4 * channels),
            nn.GELU(approximate="tanh"),
            nn.Linear(4 * channels, channels),
        )

    def forward(self, hidden: Tensor, windows: Windows) -> Tensor:
        """Return the features after the block, (N, channels)."""
        hidden = hidden + self.attention(self.norm_attention(hidden), windows)
        updated: Tensor = hidden + self.mlp(self.norm_mlp(hidden))
        return updated


class PhysicsDecoder(nn.Module):
    """A decoder from latents to the physical properties and the class of every voxel.

    `size` is one of `SIZES` or another. The latents, properties and classes of `contents` give the
    widths of input and heads.
    """

    def __init__(self, size: DecoderSize, contents: Contents = PIXIEVERSE) -> None:
        super().__init__()
        self.size = size
        self.embed = nn.Linear(contents.latents.channels, size.channels)
        self.blocks = nn.ModuleList(
            SwinBlock(size.channels, size.heads) for _ in range(size.blocks)
        )
        self.norm = nn.LayerNorm(size.channels, eps=1e-6, elementwise_affine=False)
        self.regression = nn.Linear(size.channels, len(contents.properties))
        self.classification = nn.Linear(size.channels, contents.n_classes)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        # Zero weights start the regression in the middle of tanh, where its slope is largest.
        for head in (self.regression, self.classification):
            nn.init.zeros_(head.weight)

    def forward(self, coords: Tensor, feats: Tensor) -> Prediction:
        """Predict from voxels (N, 4), batch column first, and standardised latents (N, channels).

        Rows may be in any order.
        """
        windows = [partition(coords, shift) for shift in (0, WINDOW // 2)]
        hidden = self.embed(feats) + embed_position(coords[:, 1:], self.size.channels)
        for number, block in enumerate(self.blocks):
            hidden = block(hidden, windows[number % 2])
        hidden = self.norm(hidden)
        # The heads compute in float32: the three digits of bf16 are too few for the loss.
        with torch.autocast(hidden.device.type, enabled=False):
            hidden = hidden.float()
            return Prediction(torch.tanh(self.regression(hidden)), self.classification(hidden))


def make_decoder(size: str, contents: Contents = PIXIEVERSE) -> PhysicsDecoder:
    """Return a decoder of a named size, small, medium or large, for the contents of a store."""
    return PhysicsDecoder(SIZES[size], contents=contents)
