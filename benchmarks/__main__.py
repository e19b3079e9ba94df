"""Figures, and the ledger of what is claimed by them.

    python -m benchmarks                         # lists the benchmarks
    python -m benchmarks TOPIC [--quick] [--fresh] [--seconds N] [--record] [options of its own]
    python -m benchmarks claims [--topic TOPIC] [--markdown] [--check-docs | --write-docs]
    python -m benchmarks record CLAIM VALUE [--interval LOW HIGH] [--note TEXT]
    python -m benchmarks sentinel [TOPIC…] [--record]   # do the figures stand?

`--record` writes what was measured into the ledger. Some topics need outside files: CURVAFIT_DATA names a folder that
holds `gallery/` and `scans/`.
"""

from __future__ import annotations

import argparse
import ast
import sys
from importlib import import_module
from pathlib import Path

from benchmarks.claims import Ledger
from benchmarks.harness import Cases, Figure, show


def topics() -> list[str]:
    paths = sorted(Path(__file__).parent.glob("*.py"))
    return [path.stem for path in paths if "\ndef run(options" in path.read_text("utf-8")]


def main(arguments: list[str]) -> None:
    name, *others = arguments or [""]
    if name in ("claims", "record"):
        {"claims": claims, "record": record}[name](others)
    elif name == "sentinel":
        import_module("benchmarks.sentinel").main(others)
    elif name in topics():
        run(name, others)
    else:
        print(__doc__)
        for topic in topics():
            source = Path(__file__).with_name(f"{topic}.py").read_text("utf-8")
            print(f"  {topic:12} {(ast.get_docstring(ast.parse(source)) or '').partition(chr(10))[0]}")
        if name not in ("", "-h", "--help"):
            raise SystemExit(f"there is no benchmark {name!r}")


def run(topic: str, arguments: list[str]) -> None:
    """Run a topic, and set what it measured beside what the ledger says."""
    module, ledger = import_module(f"benchmarks.{topic}"), Ledger()
    kind = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(f"python -m benchmarks {topic}", description=module.__doc__, formatter_class=kind)
    parser.add_argument("--quick", action="store_true", help="the smallest case, to see that it runs")
    parser.add_argument("--fresh", action="store_true", help="compute cases of other commits again")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after that")
    parser.add_argument("--record", action="store_true", help="write the figures into the ledger")
    getattr(module, "options", lambda parser: None)(parser)
    options = parser.parse_args(arguments)
    cases = Cases(topic, quick=options.quick, fresh=options.fresh, seconds=options.seconds)
    figures: dict[str, Figure] = module.run(options, cases)
    cases.close()
    known = {name: figure for name, figure in figures.items() if name in ledger.claims}
    if known and not options.quick:
        rows = [[name, ledger.claims[name].text or "not run", figure] for name, figure in known.items()]
        show(["claim", "in the ledger", "now"], rows, "beside the ledger")
    if options.record and options.quick:
        raise SystemExit("--quick only shows that the code runs: its figures are not recorded")
    if options.record:
        ledger.record(known)


def claims(arguments: list[str]) -> None:
    """Print the ledger, or compare the pages with it."""
    parser = argparse.ArgumentParser("python -m benchmarks claims")
    parser.add_argument("--topic")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--check-docs", action="store_true", help="exit with 1 if a page prints another figure")
    parser.add_argument("--write-docs", action="store_true", help="rewrite the tables of pages")
    options = parser.parse_args(arguments)
    if not (options.check_docs or options.write_docs):
        return Ledger().print(options.topic, options.markdown)
    wrong = Ledger().pages(write=options.write_docs)
    print("\n".join(wrong) or "pages and ledger agree")
    sys.exit(bool(wrong))


def record(arguments: list[str]) -> None:
    """Record a value by hand."""
    parser = argparse.ArgumentParser("python -m benchmarks record")
    parser.add_argument("claim")
    parser.add_argument("value", type=float)
    parser.add_argument("--interval", type=float, nargs=2, metavar=("LOW", "HIGH"), default=(None, None))
    parser.add_argument("--note", default="", help="what is to be known of it: on which machine, beside what")
    options = parser.parse_args(arguments)
    Ledger().record({options.claim: Figure(options.value, *options.interval)}, options.note)


if __name__ == "__main__":
    main(sys.argv[1:])
