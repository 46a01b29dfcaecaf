"""What the store is for: load it into PyTorch, train the paper's decoder, measure it.

`splits`, `predictions` and `metrics` need numpy alone. Everything else needs
PyTorch, which ``pip install slatprep[train]`` brings; `slatprep.torch` is the
door to the loader.
"""

from __future__ import annotations

from slatprep.errors import SlatprepError


def require_torch() -> None:
    """Say what to install where PyTorch is missing.

    Raises
    ------
    SlatprepError
        If PyTorch cannot be imported.
    """
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise SlatprepError(
            f"PyTorch cannot be imported ({error}); install it with `pip install slatprep[train]`"
        ) from error
