"""Materials of particles, such as Gaussians and point clouds, and their simulation."""
