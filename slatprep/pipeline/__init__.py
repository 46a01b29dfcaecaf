"""The stages in order, for one asset and for a dataset."""
