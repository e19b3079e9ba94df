"""A scan as it is read: what is structure in it, how it blurs and how noisy it is, and the grid it is worked on."""
