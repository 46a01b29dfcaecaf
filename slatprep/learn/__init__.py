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

from slatprep.errors import ConfigError, needing

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if error.name == "torch":
            require_torch()
        raise


def require_torch(device: str | None = "cpu") -> str:
    """Make sure that PyTorch is installed and finds the device, ``cpu`` or ``cuda``; return it.

    None stands for the GPU, or the processor if there is none. ConfigError if PyTorch cannot be
    imported, with the command that installs it, or finds no ``cuda``.
    """
    with needing("decoders need", "train"):
        import torch
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"PyTorch {torch.__version__} finds no CUDA device; expected an NVIDIA GPU and a build "
            "of PyTorch for it, or --device cpu"
        )
    return device or ("cuda" if torch.cuda.is_available() else "cpu")
