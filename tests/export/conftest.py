"""The store that exports are made of."""

from pathlib import Path

import pytest

from slatprep.pipeline.dataset import BuildSummary


@pytest.fixture
def store(mixed_build: BuildSummary) -> Path:
    return mixed_build.store
