"""Demo assets as their readers give them, each with its truth."""

from pathlib import Path

from slatprep.demo import make_demo
from slatprep.inspect.score import Truth, read_truth
from slatprep.parameters.files import load_parameters
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import MaterialField, StructuredLatents

Case = tuple[MaterialField, StructuredLatents, Truth]


def made_cases(root: Path, assets: int, seed: int, *levels: int) -> list[Case]:
    """Make demo assets of some levels; return them."""
    pairs = discover(load_parameters(make_demo(root, assets, seed, levels=levels).config))
    truths = (read_truth(root / "truth" / f"{pair.asset_id}.npz") for pair in pairs)
    return [(read_field(p), read_latents(p), one) for p, one in zip(pairs, truths, strict=True)]
