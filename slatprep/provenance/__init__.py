"""What every number of a store was made from, by what, and how well: a record an asset."""
