"""The rules: what stood there stands, what is new is whole, one sentence, an exit code that says so."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from .case import Case, Fault, Place
from .outputs import flaws
from .sandbox import FILLED, Outcome, commanding, run

#: A name that a program gives to what it has not finished.
_TEMPORARY = re.compile(r"(^|/)\.[^/]*|\.part(/|$)|(^|/)tmp[a-z0-9_]{8}(/|$)")
_ALLOWED = re.compile(r"^(\[ *\d+ %\] |note: |\w+: .*; licence )")
_CRASH = re.compile(r"Traceback \(most recent call last\)|^Exception ignored|Fatal Python error|^Exception in ", re.M)

#: What a build says that draws on, as it should where hardly any shape of a design is viable: it is given time to.
_AT_WORK = re.compile(r"viable of \d+ draws|a design with viable shapes")
#: Exit codes of a run that a signal ended.
STOPPED = (130, 143, -15, -2)
#: Bytes beyond which a file's time stands for its content.
_LARGE = 1 << 28

Standing = dict[str, tuple]


def judged(case: Case, place: Place) -> list[Fault]:
    """Set up, run the command once, and judge."""
    if case.play is not None:
        return case.play(case, place)
    before = standing(place.here)
    outcome = run(commanding(case.arguments(place)), place.here, place.root / "said")
    return [*spoken(outcome), *left(case, place, before, outcome.code)]


def spoken(outcome: Outcome, codes: Iterable[int] = (0, 1, 2)) -> list[Fault]:
    """What the exit code and the two streams say."""
    found = []
    last = (outcome.stderr.strip().splitlines() or [""])[-1][:200]
    if outcome.hung and _AT_WORK.search(last) and outcome.filled < FILLED:
        return []
    if outcome.hung:
        return [Fault("hung", f"{outcome.hung}; last said: {last!r}")]
    crashed = _CRASH.search(outcome.stderr)
    if crashed:
        found.append(Fault("tracebacks", f"exit code {outcome.code}: {last}"))
    elif outcome.code not in codes:
        column = "tracebacks" if outcome.code < 0 and outcome.code not in (-15, -2) else "wrong"
        found.append(Fault(column, f"exit code {outcome.code}, last said: {last!r}"))
    if outcome.code in (1, 2) and not found:
        found += _one_sentence(outcome)
    return found


def _one_sentence(outcome: Outcome) -> list[Fault]:
    lines = [line for line in outcome.stderr.split("\n") if line.strip() and not _ALLOWED.match(line)]
    if outcome.code == 1:
        return [] if lines else [Fault("wrong", "exit code 1, nothing said on the error stream")]
    told = " | ".join(lines)[:300]
    if len(lines) != 1 or not lines[0].startswith("error: "):
        return [Fault("wrong", f"exit code 2 with {len(lines)} lines on the error stream: {told}")]
    if len(lines[0].strip()) < 12:
        return [Fault("wrong", f"exit code 2 without a reason: {told!r}")]
    if outcome.stdout.strip():
        return [Fault("wrong", f"exit code 2 with text on the output stream: {outcome.stdout[:200]!r}")]
    return []


def left(case: Case, place: Place, before: Standing, code: int) -> list[Fault]:
    """What became of the files that stood there, and what is new."""
    after = standing(place.here)
    return [*_lost(before, after, case.changes), *_torn(case, place, before, after, code)]


def _lost(before: Standing, after: Standing, changes: Sequence[str]) -> list[Fault]:
    gone = [name for name, was in before.items() if after.get(name) != was and not matching(name, changes)]
    if not gone:
        return []
    how = "changed" if gone[0] in after else "deleted"
    more = f" and {len(gone) - 1} more" if len(gone) > 1 else ""
    return [Fault("lost", f"{how}: {gone[0]}{more}")]


def _torn(case: Case, place: Place, before: Standing, after: Standing, code: int) -> list[Fault]:
    new = [name for name in after if name not in before]
    temporary = [name for name in new if _TEMPORARY.search(name) and not _asked_for(case, name)]
    if temporary:
        return [Fault("torn", f"exit code {code} and a temporary name is left: {temporary[0]}")]
    if code != 0:
        kept = [name for name in new if not matching(name, (*case.stays, *case.changes))]
        done = code in STOPPED and _complete(place, kept)
        return [Fault("torn", f"exit code {code} and left behind: {', '.join(kept[:4])}")] if kept and not done else []
    touched = [name for name in after if after[name] != before.get(name) and after[name][0] != "folder"]
    roots = sorted({_root(name) for name in touched})
    return [Fault(column, f"exit code 0 and {said}") for name in roots for column, said in flaws(place.here / name)]


def _asked_for(case: Case, name: str) -> bool:
    """Whether the command names a hidden output, whose picture and record are hidden as well."""
    told = [part.removeprefix("--output=").rpartition(".")[0] for part in case.command]
    return any(stem.startswith(".") and name.startswith(f"{stem}.") for stem in told)


def _complete(place: Place, names: Sequence[str]) -> bool:
    """Whether what a stopped run left is what it was to make, whole: with a record where it belongs; a picture comes
    last."""
    roots = {_root(name) for name in names}
    alone = all(name.endswith(".npz") for name in roots)
    ends = {name.rpartition(".")[2] for name in roots}
    return (alone or {"json"} < ends - {"png"}) and not any(list(flaws(place.here / name)) for name in roots)


def _root(name: str) -> str:
    """A Zarr store counts as one output."""
    found = re.match(r"(.*?\.zarr)/", name)
    return found[1] if found else name


def matching(name: str, patterns: Sequence[str]) -> bool:
    """Whether a name, or a folder that it is in, matches one of the patterns."""
    parts = name.split("/")
    heads = ["/".join(parts[: k + 1]) for k in range(len(parts))]
    return any(fnmatchcase(head, pattern) for head in heads for pattern in patterns)


def standing(folder: Path) -> Standing:
    """Everything in a folder: kind, and a digest of a file's bytes, a link's target."""
    found: Standing = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root, name)
            found[str(path.relative_to(folder))] = _identity(path)
    return found


def _identity(path: Path) -> tuple:
    try:
        about = path.lstat()
        mode = about.st_mode
        if stat.S_ISLNK(mode):
            return "link", os.readlink(path)
        if stat.S_ISREG(mode) and about.st_size > _LARGE:
            return "file", about.st_size, about.st_mtime_ns
        if stat.S_ISREG(mode):
            return "file", hashlib.sha256(path.read_bytes()).hexdigest()
        return ("folder",) if stat.S_ISDIR(mode) else ("device", stat.S_IFMT(mode))
    except FileNotFoundError:  # a rival moved it meanwhile
        return ("gone",)
