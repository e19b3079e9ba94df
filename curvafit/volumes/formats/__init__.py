"""File formats of volumes: readers of what a file states.

A new one is a function that returns `base.Stated`, with its suffixes in `READERS` of `volumes/read.py`, and in `KEYED`
there if its files hold several arrays; a format that is written too has a row in `WRITERS` of `volumes/write.py`.
"""
