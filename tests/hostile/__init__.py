"""Damage, odd words, bombs, signals, full disks and rivals against the command line."""
