"""What people look at: checks, overviews, pictures, the report, verification."""
