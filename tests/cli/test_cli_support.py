"""Progress where there is no terminal: lines that a log can hold."""

from __future__ import annotations

from curvafit.cli.support import stages


def test_a_stage_that_counts_on_is_a_line_every_five_percent(capsys):
    with stages() as progress:
        for k in range(1000):
            progress(f"{k} of 1000 draws checked", 0.9 * k / 1000)
        progress("making draw 12 again", 0.9)
        progress("making draw 12 again", 0.9)
    lines = capsys.readouterr().err.splitlines()
    assert 15 <= len(lines) <= 21
    assert lines[0] == "[  0 %] 0 of 1000 draws checked" and lines[-1] == "[ 90 %] making draw 12 again"
