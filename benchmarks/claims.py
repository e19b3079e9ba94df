"""The ledger: each figure that README or docs print, and each bar of the work at hand, is a claim, and data.

`claims.toml` holds groups of claims. A group has `claims`, a list, or `columns` and `rows`, a table of them. What a
claim does not say its group says: `topic`, `command`, `format`, `bar`, `chosen_on`, `reported_on`, `note`. A row is a
key, a label and its cells, by default the claims `group.row.column`: `row.column` where the row's key begins with `=`,
and the column's key with the row's in place of `*`. A cell may be text instead, or `@` and the name of a claim.

Values are the last lines of figures in `benchmarks/results/TOPIC.jsonl`, which `record` appends. They stand while the
topic's sentinel does (`sentinel`): one measured before it changed says so.

A `page` prints its group between the marks `<!-- ledger: GROUP -->` and `<!-- end -->`; a `list` prints claims of
several groups so. `prose` are sentences of pages with figures in them, which are compared and never rewritten.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from benchmarks.harness import (
    RESULTS,
    ROOT,
    SENTINEL,
    Figure,
    Values,
    all_lines,
    append_lines,
    markdown,
    provenance,
    read_lines,
    show,
)

LEDGER = ROOT / "benchmarks" / "claims.toml"
#: What a claim takes from its group where it does not say it.
INHERITED = ("topic", "command", "format", "bar", "chosen_on", "reported_on", "note")


@dataclass(frozen=True)
class Claim:
    """One figure: what it says, how it was measured, and what it is held to."""

    id: str
    says: str
    figure: Figure | None
    topic: str
    command: str = ""
    format: str = "{:g}"
    bar: str = ""
    chosen_on: str = ""
    reported_on: str = ""
    note: str = ""
    commit: str = ""
    processor: str = ""
    date: str = ""

    @property
    def state(self) -> str:
        """`not run`, `sentinel disagrees`, `met` or `missed`, or `stated` where there is no bar."""
        if self.figure is None:
            return "not run"
        if self.date < changed().get(self.topic, ""):
            return "sentinel disagrees"
        return "stated" if not self.bar else "met" if meets(self.figure.value, self.bar) else "missed"

    @property
    def text(self) -> str:
        """The value as pages print it, with its interval; bold where it misses its bar."""
        if self.figure is None:
            return ""
        value, low, high = self.figure
        text, span = _signed(self.format.format(value)), ""
        if low is not None and high is not None:
            number = re.sub(r".*(\{.*\}).*", r"\1", self.format)
            span = f"{_signed(number.format(low))} to {_signed(number.format(high))}"
            if math.isnan(value):
                return f"{_signed(number.format(low))} to {_signed(self.format.format(high))}"
        text = f"**{text}**" if self.bar and not meets(value, self.bar) else text
        return f"{text} ({span})" if span else text

    @property
    def call(self) -> str:
        return f"`{self.command}`" if self.command else ""


def meets(value: float, bar: str) -> bool:
    """Whether a value meets a bar: `>= 0.9`, `<= 4`, `= 0`, `0.95 to 1.05`."""
    if match := re.fullmatch(r"(\S+) to (\S+)", bar):
        return float(match[1]) <= value <= float(match[2])
    sign, number = bar.split()
    return {">=": value >= float(number), "<=": value <= float(number), "=": value == float(number)}[sign]


def _signed(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")


class Ledger:
    """All claims, and the tables and sentences of pages that print them."""

    def __init__(self) -> None:
        self.content = tomllib.loads(LEDGER.read_text(encoding="utf-8"))

    @cached_property
    def claims(self) -> dict[str, Claim]:
        found: dict[str, Claim] = {}
        borrowed: dict[str, Claim] = {}
        for group in self.content["group"]:
            for claim, own in _claims_of(group):
                if own and claim.id in found:
                    raise SystemExit(f"two claims are called {claim.id}: rename one in {LEDGER.name}")
                (found if own else borrowed).setdefault(claim.id, claim)
        return borrowed | found

    def print(self, topic: str | None, as_markdown: bool) -> None:
        """Print the ledger, or what concerns one topic."""
        chosen = [claim for claim in self.claims.values() if topic in (None, claim.topic)]
        columns = ["claim", "value", "bar", "state", "command"]
        rows = [[c.id, c.text, c.bar, c.state, c.call] for c in chosen]
        if as_markdown:
            columns += ["what", "chosen on", "reported on", "commit, processor"]
            origins = [", ".join(filter(None, (c.commit, c.processor, c.note))) for c in chosen]
            more = [[c.says, c.chosen_on, c.reported_on, origin] for c, origin in zip(chosen, origins, strict=True)]
            print(markdown(columns, [a + b for a, b in zip(rows, more, strict=True)]))
        else:
            show(columns, [[cell[:70] for cell in row] for row in rows])
        states = [claim.state for claim in chosen]
        print(f"\n{len(states)} claims:", ", ".join(f"{states.count(each)} {each}" for each in dict.fromkeys(states)))

    # ---- pages -------------------------------------------------------------------------------------------------------

    def tables(self) -> Iterator[tuple[Path, str, str]]:
        """Page, mark and text of each table that a page prints."""
        for group in self.content["group"]:
            if "page" in group:
                yield ROOT / group["page"], group["id"], self._table(group)
        for part in self.content.get("list", []):
            claims = [self.claims[name] for name in part["claims"]]
            yield ROOT / part["page"], part["id"], _listed(part["head"], claims)

    def _table(self, group: Mapping[str, Any]) -> str:
        if "columns" not in group:
            return _listed(group.get("head", "what"), [self.claims[claim["id"]] for claim in group["claims"]])
        formats, rows = group["formats"], []
        for row in group["rows"]:
            cells = zip(cells_of(group, row), formats, strict=True)
            texts = [replace(self.claims[name], format=form).text if name else text for (name, text, _), form in cells]
            rows.append([row[1], *texts])
        command = f"`{group['command']}`" if "command" in group else ""
        below = "; ".join(filter(None, (command, group.get("reported_on"), group.get("note"))))
        return markdown([group.get("head", ""), *group["columns"]], rows) + (f"\n\n*{below}.*" if below else "")

    def pages(self, *, write: bool) -> list[str]:
        """Return what pages print otherwise than the ledger; or rewrite their tables, and return what is left."""
        wrong, printed = [], {(path, mark) for path, mark, _ in self.tables()}
        for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
            marks = re.findall(r"^<!-- ledger: (.+) -->$", path.read_text(encoding="utf-8"), re.MULTILINE)
            empty = [mark for mark in marks if (path, mark) not in printed]
            wrong += [f"{path.relative_to(ROOT)}: the ledger prints no table {mark} there" for mark in empty]
        for path, mark, text in self.tables():
            page = path.read_text(encoding="utf-8") if path.exists() else ""
            begin, end = f"<!-- ledger: {mark} -->", "<!-- end -->"
            found = re.compile(rf"{re.escape(begin)}\n(.*?){end}", re.DOTALL).search(page)
            wanted = f"\n{text}\n\n" if text else ""
            if found is None:
                wrong.append(f"{path.relative_to(ROOT)}: no mark {begin}")
            elif found[1] != wanted and write:
                page = page[: found.start()] + f"{begin}\n{wanted}{end}" + page[found.end() :]
                path.write_text(page, encoding="utf-8")
            elif found[1] != wanted:
                wrong.append(f"{path.relative_to(ROOT)}: table {mark} differs from the ledger")
        return wrong + [text for part in self.content.get("prose", []) for text in self._missing(part)]

    def _missing(self, part: Mapping[str, Any]) -> Iterator[str]:
        figures = [self.claims[name].figure for name in part["claims"]]
        sentence = part["text"].format(*(math.nan if figure is None else figure.value for figure in figures))
        page = (ROOT / part["page"]).read_text(encoding="utf-8")
        if " ".join(sentence.split()) not in " ".join(page.replace("\N{MINUS SIGN}", "-").split()):
            yield f"{part['page']}: expected the words {sentence!r}"

    # ---- recording ---------------------------------------------------------------------------------------------------

    def record(self, figures: Mapping[str, Figure], note: str = "") -> None:
        """Append the values of claims to the results of their topics."""
        if unknown := [name for name in figures if name not in self.claims]:
            raise SystemExit(f"no such claim: {', '.join(unknown)}; python -m benchmarks claims lists them")
        about = provenance() | ({"note": note} if note else {})
        for topic in {self.claims[name].topic for name in figures}:
            lines = [{"figure": name} | {key: v for key, v in figure._asdict().items() if v is not None} | about
                     for name, figure in figures.items() if self.claims[name].topic == topic]  # fmt: skip
            append_lines(RESULTS / f"{topic}.jsonl", lines)
            print(f"recorded {len(lines)} values of {topic}")


def cells_of(group: Mapping[str, Any], row: list[str]) -> Iterator[tuple[str, str, bool]]:
    """Yield of each cell of a row the claim's name, or none and the cell's text; and whether the claim is the row's."""
    head = row[0][1:] if row[0].startswith("=") else f"{group['id']}.{row[0]}"
    for k, key in enumerate(group["keys"]):
        cell = row[2 + k] if len(row) > 2 else "?"
        name = key.replace("*", row[0]) if "*" in key else f"{head}.{key}"
        yield (name, "", True) if cell == "?" else (cell[1:], "", False) if cell[:1] == "@" else ("", cell, False)


def _claims_of(group: Mapping[str, Any]) -> Iterator[tuple[Claim, bool]]:
    """Yield the claims of a group, and whether each is its own; of another's that its table prints no bar is known."""
    common = {key: group[key] for key in INHERITED if key in group}
    for row in group.get("claims", []):
        yield _claim(row["id"], row["says"], common | {key: row[key] for key in INHERITED if key in row}), True
    for row in group.get("rows", []):
        for k, (name, _, own) in enumerate(cells_of(group, row)):
            if name:
                says = ", ".join(filter(None, (group.get("title", ""), row[1], group["columns"][k])))
                bar = {"bar": group["bars"][k]} if own and "bars" in group else {}
                yield _claim(name, says, common | {"format": group["formats"][k]} | bar), own


def _claim(name: str, says: str, rest: dict[str, Any]) -> Claim:
    line = _recorded().get(name)
    if line is None:
        return Claim(name, says, None, **rest)
    rest |= {key: line[key] for key in ("commit", "processor", "note", "date", "topic") if line.get(key)}
    return Claim(name, says, Figure(line["value"], line.get("low"), line.get("high")), **rest)


@lru_cache
def _recorded() -> dict[str, Values]:
    """Return the last line of each figure, with its topic."""
    return {name: line | {"topic": path.stem} for path in sorted(RESULTS.glob("*.jsonl"))
            for name, line in read_lines(path, "figure").items()}  # fmt: skip


@lru_cache
def changed() -> dict[str, str]:
    """Return since when a topic's sentinel gives what it gives, of topics where it once gave something else."""
    first: dict[str, Values] = {}
    found: dict[str, str] = {}
    for line in all_lines(SENTINEL, "sentinel"):
        if first.setdefault(line["sentinel"], line["values"]) != line["values"]:
            found |= dict.fromkeys(line["sentinel"].split(), line["date"])
    return found


def _listed(head: str, claims: list[Claim]) -> str:
    """Return a table of claims; a command that all share stands below it."""
    rows = [[claim.says, claim.text, claim.call] for claim in claims if claim.figure is not None]
    if len({row[2] for row in rows}) == 1:
        return markdown([head, "figure"], [row[:2] for row in rows]) + f"\n\n*{rows[0][2]}.*"
    return markdown([head, "figure", "command"], rows) if rows else ""
