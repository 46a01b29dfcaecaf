"""Load a store into PyTorch, train SLAT-Phys's decoder, predict, and measure predictions.

``pip install 'slatprep[train]'`` brings PyTorch, which the loader needs;
`splits`, `predictions` and `metrics` need numpy alone.

>>> from slatprep.learn import SlatDataset, SlatLoader  # doctest: +SKIP
>>> train = SlatDataset("demo.zarr", "train", verdicts=("good",))  # doctest: +SKIP
>>> loader = SlatLoader(train, batch_size=4, shuffle=True, workers=2)  # doctest: +SKIP
>>> batch = next(iter(loader))  # doctest: +SKIP
>>> batch.coords.shape, batch.feats.shape  # doctest: +SKIP
(torch.Size([21234, 4]), torch.Size([21234, 8]))
"""

import lazy_loader

from slatprep.errors import SlatprepError

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if error.name == "torch":
            require_torch()
        raise


def require_torch() -> None:
    """Make sure that PyTorch is installed.

    Raises
    ------
    SlatprepError
        If it cannot be imported; the message says what to install.
    """
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise SlatprepError(
            f"PyTorch cannot be imported ({error}); install it with `pip install 'slatprep[train]'`"
        ) from error
