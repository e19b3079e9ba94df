"""File formats of volumes: readers of what a file states. CONTRIBUTING.md says how to add one."""
