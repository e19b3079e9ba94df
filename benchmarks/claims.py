"""The ledger: each figure that README or docs print, and each bar of the work at hand, is a claim, and data.

`claims.toml` holds groups of claims. A group has `claims`, a list, or `columns` and `rows`, a table of them, whose ids
are group.row.column. What a claim does not say its group says: `topic`, `command`, `format`, `bar`, `chosen_on`,
`reported_on`, `processor`, `note`; and of a value that was measured before the ledger was, `at`, its commit, and
`then`, the command there if today's is another or none. `record` writes a value that was measured since into
`benchmarks/results/TOPIC.jsonl`, which has the last word.

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

from benchmarks.harness import RESULTS, ROOT, Figure, append_lines, markdown, provenance, read_lines, show, write_whole

LEDGER = ROOT / "benchmarks" / "claims.toml"
#: What a claim takes from its group where it does not say it.
INHERITED = ("topic", "command", "then", "at", "format", "bar", "chosen_on", "reported_on", "processor", "note")


@dataclass(frozen=True)
class Claim:
    """One figure: what it says, how it was measured, and what it is held to."""

    id: str
    says: str
    figure: Figure | None
    topic: str
    command: str = ""
    then: str = ""
    at: str = ""
    format: str = "{:g}"
    bar: str = ""
    chosen_on: str = ""
    reported_on: str = ""
    processor: str = ""
    note: str = ""
    commit: str = ""

    @property
    def state(self) -> str:
        """`not run`, `met` or `missed`, `stated` where there is no bar; and what is to be known of the value."""
        if self.figure is None:
            return "not run"
        state = "stated" if not self.bar else "met" if meets(self.figure.value, self.bar) else "missed"
        return f"{state}, not re-run" if self.at else state

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
        """The command of today, or the one of the commit at which there was one."""
        return f"`{self.command}`" if self.command else f"`{self.then}` at {self.at}" if self.then else ""


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
        for group in self.content["group"]:
            for claim in _claims_of(group):
                if claim.id in found:
                    raise SystemExit(f"two claims are called {claim.id}: rename one in {LEDGER.name}")
                found[claim.id] = claim
        return found

    def of(self, topic: str | None) -> list[Claim]:
        return [claim for claim in self.claims.values() if topic in (None, claim.topic)]

    def print(self, topic: str | None, as_markdown: bool) -> None:
        """Print the ledger, or what concerns one topic."""
        columns = ["claim", "value", "bar", "state", "command"]
        rows = [[c.id, c.text, c.bar, c.state, c.call] for c in self.of(topic)]
        if as_markdown:
            columns += ["what", "chosen on", "reported on", "commit, processor"]
            more = [[c.says, c.chosen_on, c.reported_on, _origin(c)] for c in self.of(topic)]
            print(markdown(columns, [a + b for a, b in zip(rows, more, strict=True)]))
        else:
            show(columns, [[cell[:70] for cell in row] for row in rows])
        states = [claim.state for claim in self.of(topic)]
        counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
        print(f"\n{len(states)} claims: {counts}")

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
        rows, formats = [], group.get("formats", ["{}"] * len(group["keys"]))
        for key, label, *cells in group["rows"]:
            claims = [self.claims.get(f"{group['id']}.{key}.{column}") for column in group["keys"]]
            parts = zip(claims, cells, formats, strict=True)
            texts = [cell if claim is None else replace(claim, format=form).text for claim, cell, form in parts]
            rows.append([label, *texts])
        first = next(claim for claim in claims if claim is not None)
        since = f"not run again since {first.at}" if first.at and first.command else ""
        told = "; ".join(filter(None, (first.call, since, group.get("reported_on"), group.get("note"))))
        return markdown([group.get("head", ""), *group["columns"]], rows) + (f"\n\n*{told}.*" if told else "")

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
            pattern = re.compile(rf"{re.escape(begin)}\n(.*?){end}", re.DOTALL)
            found = pattern.search(page)
            wanted = f"\n{text}\n\n" if text else ""
            if found is None:
                wrong.append(f"{path.relative_to(ROOT)}: no mark {begin}")
            elif found[1] != wanted and write:
                page = page[: found.start()] + f"{begin}\n{wanted}{end}" + page[found.end() :]
                write_whole(path, lambda temporary, page=page: temporary.write_text(page, encoding="utf-8"))
            elif found[1] != wanted:
                wrong.append(f"{path.relative_to(ROOT)}: table {mark} differs from the ledger")
        return wrong + [said for part in self.content.get("prose", []) for said in self._missing(part)]

    def _missing(self, part: Mapping[str, Any]) -> Iterator[str]:
        claims = [self.claims[name].figure for name in part["claims"]]
        values = [figure.value if figure is not None else float("nan") for figure in claims]
        sentence = part["text"].format(*values)
        page = (ROOT / part["page"]).read_text(encoding="utf-8")
        if " ".join(sentence.split()) not in " ".join(page.replace("\N{MINUS SIGN}", "-").split()):
            yield f"{part['page']}: expected the words {sentence!r}"

    # ---- recording ---------------------------------------------------------------------------------------------------

    def record(self, figures: Mapping[str, Figure], note: str = "") -> None:
        """Write the values of claims into the committed files of their topics."""
        if unknown := [name for name in figures if name not in self.claims]:
            raise SystemExit(f"no such claim: {', '.join(unknown)}; python -m benchmarks claims lists them")
        for topic in {self.claims[name].topic for name in figures}:
            mine = {name: figure for name, figure in figures.items() if self.claims[name].topic == topic}
            about = provenance() | ({"note": note} if note else {})
            lines = [{"figure": name} | _given(figure) | about for name, figure in mine.items()]
            append_lines(RESULTS / f"{topic}.jsonl", lines)
            print(f"recorded {len(mine)} values of {topic}")


def _given(figure: Figure) -> dict[str, float]:
    return {key: value for key, value in figure._asdict().items() if value is not None}


def _claims_of(group: Mapping[str, Any]) -> Iterator[Claim]:
    common = {key: group[key] for key in INHERITED if key in group}
    for row in group.get("claims", []):
        value = row.get("value")
        yield _claim(row["id"], row["says"], value, common | {key: row[key] for key in INHERITED if key in row})
    for key, label, *cells in group.get("rows", []):
        for k, (cell, column) in enumerate(zip(cells, group["keys"], strict=True)):
            own = {name: group[f"{name}s"][k] for name in ("format", "bar") if f"{name}s" in group}
            if not isinstance(cell, str) or cell == "?":
                says = ", ".join(filter(None, (group.get("title", ""), label, group["columns"][k])))
                yield _claim(f"{group['id']}.{key}.{column}", says, cell, common | own)


def _claim(name: str, says: str, value: Any, rest: dict[str, Any]) -> Claim:
    recorded = _recorded(rest["topic"]).get(name)
    if recorded is not None:
        rest = rest | {key: recorded[key] for key in ("commit", "processor", "note") if recorded.get(key)}
        return Claim(name, says, Figure(*(recorded.get(key) for key in Figure._fields)), **rest | {"at": ""})
    figure = None if value in (None, "?") else Figure(*value) if isinstance(value, list) else Figure(value)
    return Claim(name, says, figure, **rest)


@lru_cache
def _recorded(topic: str) -> dict[str, Any]:
    return read_lines(RESULTS / f"{topic}.jsonl", "figure")


def _listed(head: str, claims: list[Claim]) -> str:
    """Return a table of claims; a command that all share stands below it."""
    rows = [[claim.says, claim.text, claim.call] for claim in claims if claim.figure is not None]
    if len({row[2] for row in rows}) == 1:
        return markdown([head, "figure"], [row[:2] for row in rows]) + f"\n\n*{rows[0][2]}.*"
    return markdown([head, "figure", "command"], rows) if rows else ""


def _origin(claim: Claim) -> str:
    return ", ".join(filter(None, (claim.commit, claim.processor, claim.note)))
