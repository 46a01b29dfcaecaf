"""Frames and voxel sets, and the compiled kernels on 64^3 voxels."""
