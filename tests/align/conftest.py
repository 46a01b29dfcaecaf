"""Demo assets of every level, each level made once."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.shapes import Case

from slatprep.demo import make_demo
from slatprep.inspect.score import read_truth
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_field, read_latents


@pytest.fixture(scope="session")
def demo_cases(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], list[Case]]:
    """Return demo assets of a level with their truth; each level is made once."""
    made: dict[int, list[Case]] = {}

    def cases(level: int) -> list[Case]:
        if level not in made:
            root: Path = tmp_path_factory.mktemp(f"level{level}")
            make_demo(root, assets=14, seed=11, levels=(level,))
            parameters = BuildParameters(
                pixieverse=PixieverseSource(root=root / "pixieverse"),
                slat=SlatSource(root=root / "slat"),
            )
            made[level] = [
                (
                    read_field(pair),
                    read_latents(pair),
                    read_truth(root / "truth" / f"{pair.asset_id}.npz"),
                )
                for pair in discover(parameters)
            ]
        return made[level]

    return cases
