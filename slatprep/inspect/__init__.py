"""Check, compare, verify and show a store: overviews, statistics, pictures, the report."""
