"""No truth test goes without notice: each that `tests/truths.txt` lists is there, and each that was listed still stands
in it, behind the name that it has now or among what is gone."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Names of tests in the list, old names and those of what is gone too.
NAMES = 1142


def test_every_truth_test_is_there() -> None:
    text = (ROOT / "tests" / "truths.txt").read_text(encoding="utf-8")
    missing, there = [], set()
    for line in text.splitlines():
        if line.startswith("tests/"):
            there = set(re.findall(r"^def (test_\w+)", (ROOT / line).read_text(encoding="utf-8"), re.MULTILINE))
        elif line.startswith("    "):
            missing += [] if line.split()[0] in there else [line]
    assert missing == []
    assert len(set(re.findall(r"\btest_\w+\b(?!\.py)", text))) >= NAMES
