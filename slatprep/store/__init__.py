"""The Zarr store: its layout, how it is written, how it is read."""

from slatprep.store.reader import Store, StoredAsset, open_store

__all__ = ["Store", "StoredAsset", "open_store"]
