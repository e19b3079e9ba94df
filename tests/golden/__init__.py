"""Numbers of a small corpus, frozen: its inputs are committed, as another processor would round some otherwise."""

from pathlib import Path

FOLDER = Path(__file__).parent / "inputs"
