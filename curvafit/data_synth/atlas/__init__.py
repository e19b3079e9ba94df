"""Atlases: which parameters to draw, who makes the shapes, and the store that keeps them."""
