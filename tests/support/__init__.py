"""What several tests share: made datasets, shapes, trees of files, pages."""
