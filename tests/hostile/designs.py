"""Designs of an atlas in YAML: aliases that explode, tags that run code, numbers that are words."""

from __future__ import annotations

from collections.abc import Iterator

from .case import Case, Place, Setup

_POINT = "{a20: 1, a11: 2, a02: 6, a10: -40, a01: -40, a00: 400, mass: -0.6}"


def _aliases(depth: int, width: int) -> str:
    lines = ["a0: &a0 [1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines)


def _nested_list(depth: int, width: int) -> str:
    """Points that stand for points, an explosion where a design has its list."""
    lines = ["list:", "- &a0 [1, 1]"]
    lines += [f"- &a{k} [{', '.join([f'*a{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines) + "\n"


def _inside(depth: int, width: int) -> str:
    """The same within one value, which a message would spell out."""
    parts = ["&a0 [1, 1]", *(f"&a{k} [{', '.join([f'*a{k - 1}'] * width)}]" for k in range(1, depth))]
    return f"[{', '.join(parts)}]"


TEXTS: dict[str, str | bytes] = {
    "empty": "",
    "null": "null\n",
    "comment": "# nothing\n",
    "list": "- 1\n- 2\n",
    "word": "tubes\n",
    "number": "42\n",
    "tabs": "box:\n\ta11: 1\n",
    "aliases-twenty": _aliases(22, 2) + "\nbox: {a11: *a21}\n",
    "aliases-key": _aliases(30, 2) + "\nlist: *a29\n",
    "aliases-law": _aliases(24, 3) + "\naround: tubes\nlaw: *a23\n",
    "aliases-around": _aliases(9, 9) + "\naround: *a8\n",
    "aliases-spread": _aliases(9, 9) + "\naround: tubes\nspread: *a8\n",
    "aliases-in-list": _nested_list(8, 8),
    "aliases-in-around": f"around: {_inside(9, 9)}\n",
    "aliases-in-spread": f"around: tubes\nspread: {_inside(9, 9)}\n",
    "aliases-in-law": f"around: tubes\nlaw: {_inside(22, 2)}\n",
    "aliases-in-box": f"box: {{a11: {_inside(9, 9)}}}\n",
    "aliases-as-box": f"box: {_inside(30, 2)}\n",
    "aliases-as-design": f"{_inside(9, 9)}\n",
    "aliases-in-point": f"around: {_POINT.replace('400', _inside(9, 9))}\n",
    "aliases-in-points": f"list: [{_inside(9, 9)}]\n",
    "alias-none": "around: *nothing\n",
    "alias-itself": "box: &a {a11: *a}\n",
    "alias-list-itself": "list: &a [*a]\n",
    "alias-around-itself": "around: &a {a20: *a, a11: 2, a02: 6, a10: -40, a01: -40, a00: 400, mass: -0.6}\n",
    "merge": "base: &b {a11: 1}\nbox: {<<: *b, a02: 3}\n",
    "merge-itself": "box: &b\n  <<: *b\n  a11: 1\n",
    "merge-word": "box:\n  <<: word\n  a11: 1\n",
    "merge-list": "box:\n  <<: [1, 2]\n",
    "object": "box: !!python/object/apply:os.system ['touch ran']\n",
    "object-new": "around: !!python/object/new:os.system ['touch ran']\n",
    "name": "around: !!python/name:os.system\n",
    "bool": "around: !!bool abc\n",
    "int": "box: {a11: !!int abc}\n",
    "int-empty": "box: {a11: !!int ''}\n",
    "float": "box: {a11: !!float abc}\n",
    "null-tag": "around: !!null abc\n",
    "binary": "around: !!binary abcd\n",
    "binary-wrong": "around: !!binary 'ä'\n",
    "binary-box": "box: {a11: !!binary abc=}\n",
    "timestamp": "around: !!timestamp 2001-99-99\n",
    "timestamp-number": "box: {a11: !!timestamp 2001-01-01}\n",
    "timestamp-plain": "box: {a11: 2001-13-45}\n",
    "date": "around: 2001-12-14\n",
    "timestamp-word": "around: !!timestamp abc\n",
    "set": "box: !!set {a11, a02}\n",
    "omap": "box: !!omap [a11: 1, a02: 2]\n",
    "omap-wrong": "box: !!omap {a11: 1}\n",
    "pairs-wrong": "list: !!pairs abc\n",
    "tag-unknown": "box: !elsewhere {a11: 1}\n",
    "tag-empty": "!<> box: 1\n",
    "directive": "%YAML 9.9\n---\naround: tubes\n",
    "directive-wrong": "%YAML abc\n---\naround: tubes\n",
    "two-documents": "around: tubes\n---\naround: sponge\n",
    "doubled-keys": "around: tubes\naround: nonsense\n",
    "doubled-names": "box: {a11: 1, a11: 2}\n",
    "list-key": "? [1, 2]\n: 3\naround: tubes\n",
    "table-key": "? {a: 1}\n: 3\n",
    "null-key": "~: 3\naround: tubes\n",
    "number-key": "1: 2\n",
    "nan": "box: {a11: .nan}\n",
    "infinity": "box: {a11: [-.inf, .inf]}\n",
    "digits": f"box: {{a11: {'9' * 400}}}\n",
    "more-digits": f"box: {{a11: {'9' * 5000}}}\n",
    "sexagesimal": "box: {a11: 190:20:30}\n",
    "octal": "box: {a11: 0o7}\n",
    "octal-wrong": "box: {a11: 08}\n",
    "binary-number": "box: {a11: 0b}\n",
    "underscores": "box: {a11: ___}\n",
    "true": "box: {a11: true}\n",
    "low-high": "box: {a11: [3, 1]}\n",
    "three": "box: {a11: [1, 2, 3]}\n",
    "mass-one": "box: {mass: 1}\n",
    "mass-many": "box: {mass: [-9, 9]}\n",
    "empty-list": "list: []\n",
    "empty-box": "box:\n",
    "list-of-null": "list: [~]\n",
    "list-of-word": "list: [none]\n",
    "point-nan": f"list: [{_POINT.replace('400', '.nan')}]\n",
    "point-short": "list: [{a20: 1}]\n",
    "point-a20": f"around: {_POINT.replace('a20: 1', 'a20: 0')}\n",
    "point-digits": f"around: {_POINT.replace('400', '9' * 400)}\n",
    "point-text": f"around: {_POINT.replace('400', 'abc')}\n",
    "point-list": f"around: {_POINT.replace('400', '[1]')}\n",
    "fit-none": "around: none.json\n",
    "fit-folder": "around: /.json\n",
    "fit-absolute": "around: /etc/passwd.json\n",
    "fit-nul": 'around: "a\\0b.json"\n',
    "fit-surrogate": 'around: "\\uD800.json"\n',
    "spread-nan": "around: tubes\nspread: .nan\n",
    "spread-infinity": "around: tubes\nspread: .inf\n",
    "spread-zero": "around: tubes\nspread: 0\n",
    "spread-huge": "around: tubes\nspread: 1e308\n",
    "spread-text": "around: tubes\nspread: much\n",
    "spread-digits": f"around: tubes\nspread: {'9' * 400}\n",
    "log-sign": "log: [a11]\nbox: {}\n",
    "log-nest": "log: [[[a02]]]\nbox: {}\n",
    "log-table": "log: {a02: 1}\nbox: {}\n",
    "law-list": "law: [random]\naround: tubes\n",
    "law-table": "law: {a: 1}\naround: tubes\n",
    "sobol-fixed": "law: sobol\nbox: {a20: 1, a11: 2, a02: 6, a10: -40, a01: -40, a00: 400, mass: 2}\n",
    "nest-flow": "[" * 3000,
    "nest-closed": "box: " + "[" * 3000 + "]" * 3000,
    "nest-tables": "box: " + "{a: " * 3000 + "1" + "}" * 3000,
    "nest-lines": "\n".join(" " * k + "a:" for k in range(1500)),
    "bom": "\ufeffaround: none\n",
    "utf-16": "around: none\n".encode("utf-16"),
    "latin-1": "around: \xfcber\n".encode("latin-1"),
    "nul": "around: tu\0bes\n",
    "bell": "around: tu\abes\n",
    "noise": bytes((k * 89 + 7) % 256 for k in range(500)),
    "unclosed": "box: {a11: [1, 2\n",
    "quote": 'around: "tubes\n',
    "question": "? ? ? ?\n",
    "anchor": "&\n",
    "anchors": "a: &x 1\nb: &x 2\nc: *x\n",
    "json": '{"around": 3}',
    "long": "around: " + "x" * 1_000_000 + "\n",
    "zip": b"PK\x03\x04" + bytes(200),
}


def cases(seed: int) -> Iterator[Case]:
    """Every text as the design of a build."""
    command = (
        "atlas",
        "build",
        "out.zarr",
        "--design",
        "design.yaml",
        "--count",
        "1",
        "--shape",
        "16",
        "--workers",
        "0",
    )
    for name, text in TEXTS.items():
        yield Case(f"designs/yaml/{name}", _writing(text), command, stays=("out.zarr", "out.zarr/*"))


def _writing(text: str | bytes) -> Setup:
    def setup(place: Place) -> None:
        place.plant("design.yaml", text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))

    return setup
