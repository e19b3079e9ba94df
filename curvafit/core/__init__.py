"""What every room uses: checks, records on disk, units, progress and signals. It imports nothing of ours."""
