"""Draw alignments, statistics and errors as pictures, or show an alignment in a window."""
