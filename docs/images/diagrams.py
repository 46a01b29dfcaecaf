"""Draw the diagrams of the documentation: `python docs/images/diagrams.py`.

Frames and deformation are slices of a made object, so they show what the code does.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

HERE = Path(__file__).parent
INK, BLUE, ORANGE, GREY, PALE = "#1f2328", "#3f51b5", "#d97706", "#9ca3af", "#eef0fb"


def save(figure: plt.Figure, name: str) -> None:
    """Write a figure as an SVG of the same bytes each time."""
    figure.savefig(HERE / f"{name}.svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


def arrow(ax: plt.Axes, start: tuple[float, float], end: tuple[float, float], **style: str) -> None:
    """Draw an arrow."""
    tip = FancyArrowPatch(
        start, end, arrowstyle="-|>", mutation_scale=11, color=INK, lw=1.1, **style
    )
    ax.add_patch(tip)


def box(ax: plt.Axes, x: float, y: float, w: float, h: float, text: str, **style: str) -> None:
    """Draw a box with a text in it."""
    look = {"fc": PALE, "ec": BLUE} | style
    ax.add_patch(
        FancyBboxPatch((x, y), w, h, boxstyle="round,pad=0,rounding_size=0.06", lw=1, **look)
    )
    ax.text(x + w / 2, y + h / 2, text, ha="center", va="center", color=INK)


def blank(width: float, height: float, across: float, up: float) -> tuple[plt.Figure, plt.Axes]:
    """Return a figure without axes, so many units across and up."""
    figure, ax = plt.subplots(figsize=(width, height))
    ax.set_xlim(0, across)
    ax.set_ylim(0, up)
    ax.axis("off")
    return figure, ax


def shape(resolution: int) -> np.ndarray:
    """Return a slice of a rubber duck: body, head and beak, as a boolean image."""
    c = (np.arange(resolution) + 0.5) / resolution - 0.5
    x, z = np.meshgrid(c, c, indexing="ij")
    body = (x / 0.30) ** 2 + ((z + 0.13) / 0.19) ** 2 < 1
    head = ((x - 0.14) / 0.14) ** 2 + ((z - 0.17) / 0.14) ** 2 < 1
    beak = (np.abs(x - 0.32) < 0.07) & (np.abs(z - 0.15) < 0.035)
    return body | head | beak


def frames() -> None:
    """Two frames, and the transform from one to the other."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 4.0), gridspec_kw={"wspace": 0.55})
    solid = shape(24)
    turned = np.rot90(solid)
    surface = turned & ~(
        np.roll(turned, 1, 0)
        & np.roll(turned, -1, 0)
        & np.roll(turned, 1, 1)
        & np.roll(turned, -1, 1)
    )
    looks = ((solid, ORANGE, "PixieVerse frame\na grid of materials, solid"),
             (surface, BLUE, "SLAT frame\nsurface voxels with latents"))  # fmt: skip
    for ax, (cells, colour, title) in zip(axes, looks, strict=True):
        for i, k in np.argwhere(cells):
            ax.add_patch(
                Rectangle((i / 24 - 0.5, k / 24 - 0.5), 1 / 24, 1 / 24, fc=colour, ec="w", lw=0.4)
            )
        ax.set(
            xlim=(-0.5, 0.5),
            ylim=(-0.5, 0.5),
            aspect="equal",
            xticks=(-0.5, 0, 0.5),
            yticks=(-0.5, 0, 0.5),
        )
        ax.set_title(title, fontsize=9.5, color=INK)
        ax.grid(color="#e5e7eb", lw=0.5)
        ax.set_axisbelow(True)
    where = figure.add_axes((0, 0, 1, 1), facecolor="none")
    where.set(xlim=(0, 1), ylim=(0, 1))
    where.axis("off")
    arrow(where, (0.455, 0.60), (0.565, 0.60))
    where.text(0.51, 0.63, "$T$: a 4x4 transform", ha="center", color=INK)
    arrow(where, (0.565, 0.42), (0.455, 0.42))
    where.text(0.51, 0.335, "$T^{-1}$: look up\nthe material", ha="center", color=INK)
    save(figure, "frames")


def deformation() -> None:
    """What a similarity leaves, and what a deformation does about it."""
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.1))
    solid = shape(64)
    c = (np.arange(64) + 0.5) / 64 - 0.5
    x, z = np.meshgrid(c, c, indexing="ij")

    def move(x: np.ndarray, z: np.ndarray, stretch: float, bend: float) -> list[np.ndarray]:
        bent = x + bend * (0.10 * z * z + 0.05 * np.sin(5 * z))
        return [bent, z * (1 - 0.16 * stretch) + stretch * 0.03 * x]

    titles = (
        "a similarity:\none scale, no bending",
        "an affine map:\nproportions fit",
        "a deformation:\nthe bend fits, too",
    )
    stages = ((1.0, 1.0), (0.0, 1.0), (0.0, 0.0))
    for ax, title, (stretch, bend) in zip(axes, titles, stages, strict=True):
        ax.contourf(x, z, solid, levels=[0.5, 1.5], colors=["#fde3c0"])
        ax.contour(x, z, solid.astype(float), levels=[0.5], colors=[ORANGE], linewidths=1.4)
        there = move(x, z, stretch, bend)
        ax.contour(*there, solid.astype(float), levels=[0.5], colors=[BLUE], linewidths=1.4)
        lines = np.linspace(-0.42, 0.42, 9)
        fine = np.linspace(-0.42, 0.42, 60)
        for at in lines:
            for a, b in ((np.full_like(fine, at), fine), (fine, np.full_like(fine, at))):
                u, v = move(a, b, 1.0 - stretch, 1.0 - bend)
                ax.plot(u, v, color=GREY, lw=0.5, zorder=0)
        ax.set(xlim=(-0.5, 0.5), ylim=(-0.46, 0.46), aspect="equal", xticks=[], yticks=[])
        ax.set_title(title, fontsize=9.5, color=INK)
    figure.text(
        0.5,
        -0.02,
        "orange: PixieVerse      blue: SLAT, as it is laid on it      grey: the map",
        ha="center",
        color=INK,
    )
    save(figure, "deformation")


def verdict() -> None:
    """From figures to probabilities to one word."""
    figure, ax = blank(9.2, 3.3, 18.4, 6.6)
    for k, text in enumerate(
        (
            "fit of the surfaces,\nby direction and block",
            "how far the next\nplacement lies below",
            "classes around\neach looked-up place",
        )
    ):
        box(ax, 0.1, 4.7 - 2.2 * k, 5.2, 1.6, text, fc="#f4f5f7", ec=GREY)
    for k, text in enumerate(("same object?", "right placement?", "right label?")):
        box(ax, 7.0, 4.7 - 2.2 * k, 3.4, 1.6, text)
        arrow(ax, (5.4, 5.5 - 2.2 * k), (6.9, 5.5 - 2.2 * k))
    box(ax, 12.0, 3.6, 2.6, 1.6, "confidence")
    arrow(ax, (10.5, 5.5), (11.9, 4.7))
    arrow(ax, (10.5, 3.3), (11.9, 4.1))
    box(ax, 12.0, 0.3, 2.6, 1.6, "expected\naccuracy")
    arrow(ax, (10.5, 1.1), (11.9, 1.1))
    for k, (word, colour) in enumerate(
        (("good", "#15803d"), ("doubtful", "#b45309"), ("failed", "#b91c1c"))
    ):
        box(ax, 15.9, 4.3 - 1.5 * k, 2.3, 1.1, word, fc="#ffffff", ec=colour)
    arrow(ax, (14.7, 4.4), (15.8, 3.5))
    arrow(ax, (14.7, 1.1), (15.8, 3.0))
    save(figure, "verdict")


def update() -> None:
    """What an update reads, computes, links and writes."""
    figure, ax = blank(9.2, 3.6, 18.4, 6.8)
    ax.set_ylim(-0.8, 6.8)
    ax.text(0.1, 6.3, "store before", color=INK, weight="bold")
    ax.text(0.1, -0.6, "store after", color=INK, weight="bold")
    shards = (
        "shard 0\nunchanged",
        "shard 1\nunchanged",
        "shard 2\none asset changed",
        "shard 3, the last\nhas room",
    )
    for k, text in enumerate(shards):
        changed = k > 1
        box(ax, 0.1 + 4.5 * k, 4.3, 3.9, 1.6, text, fc="#f4f5f7", ec=GREY)
        below = (
            "linked",
            "linked",
            "chunks copied,\nchanged rows packed",
            "chunks copied,\nnew rows added",
        )[k]
        box(
            ax,
            0.1 + 4.5 * k,
            0.0,
            3.9,
            1.3,
            below,
            fc=PALE if not changed else "#fff4e5",
            ec=BLUE if not changed else ORANGE,
        )
        arrow(ax, (2.05 + 4.5 * k, 4.2), (2.05 + 4.5 * k, 1.4))
    box(
        ax,
        10.2,
        2.2,
        6.6,
        1.2,
        "align, look up and judge\nonly what is new or changed",
        fc="#fff4e5",
        ec=ORANGE,
    )
    save(figure, "update")


def arrays() -> None:
    """Which rows of the voxel arrays belong to which asset."""
    figure, ax = blank(9.2, 3.0, 18.4, 6.0)
    colours = ("#c7d2fe", "#fde68a", "#bbf7d0")
    sizes, at = (5, 3, 6), 0
    ax.text(0.1, 5.4, "asset/*: one row per asset", color=INK, weight="bold")
    ax.text(5.4, 5.4, "voxel/*: one row per SLAT voxel", color=INK, weight="bold")
    ax.text(14.6, 5.4, "grid/*: 64³ per asset", color=INK, weight="bold")
    for k, (size, colour) in enumerate(zip(sizes, colours, strict=True)):
        y = 4.2 - 1.5 * k
        ax.add_patch(Rectangle((0.1, y), 3.2, 0.8, fc=colour, ec=INK, lw=0.8))
        ax.text(1.7, y + 0.4, f"asset {k}: id, verdict", ha="center", va="center", fontsize=8)
        for row in range(size):
            ax.add_patch(
                Rectangle((5.4, 4.66 - 0.34 * (at + row)), 6.8, 0.34, fc=colour, ec="w", lw=0.6)
            )
        arrow(ax, (3.4, y + 0.4), (5.3, 4.66 - 0.34 * (at + size / 2 - 1)))
        ax.text(
            8.8,
            4.66 - 0.34 * (at + size / 2 - 1),
            "coords, feats, properties, material, valid",
            ha="center",
            va="center",
            fontsize=8,
        )
        at += size
        for deep in range(3):
            ax.add_patch(
                Rectangle(
                    (14.9 + 0.18 * deep, y + 0.14 * deep - 0.2), 0.9, 0.9, fc=colour, ec=INK, lw=0.6
                )
            )
        ax.text(16.5, y + 0.35, "properties, material", va="center", fontsize=8)
    save(figure, "arrays")


if __name__ == "__main__":
    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "slatprep", "svg.fonttype": "path", "font.size": 9})
    for draw in (frames, deformation, verdict, update, arrays):
        draw()
