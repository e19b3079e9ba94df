"""File formats of volumes, a module each."""
