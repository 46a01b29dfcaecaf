"""Materials for particles in place of voxels: Gaussians, point clouds, and their simulation."""
