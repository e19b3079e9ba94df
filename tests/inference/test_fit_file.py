"""What a `fit.json` may hold: one schema for its readers and its writer, and JSON that cannot surprise."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from broken_fits import BROKEN, broken
from found import made_fit

from curvafit.core.records import quoted
from curvafit.core.schema import violation
from curvafit.inference.fit import FIT_SCHEMA, Fit

SENTENCE = r"\Aexpected [^\n]{1,600}\Z"


def refused(path: Path, content: str | bytes) -> str:
    """What `Fit.load` says of a file."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ValueError, match=SENTENCE) as error:
        Fit.load(path)
    return str(error.value)


@pytest.mark.parametrize(("where", "text", "said"), BROKEN)
def test_one_thing_wrong_is_named(tmp_path: Path, where: str, text: str | None, said: str) -> None:
    assert said.split()[0] in refused(tmp_path / "fit.json", broken(where, text))


@pytest.mark.parametrize(
    ("where", "text", "said"),
    [
        ("mass", "NaN", "NaN, which is not a finite number"),
        ("coefficients.a00", "-Infinity", "-Infinity, which is not a finite number"),
        ("epsilon_physical", "1e999", "1e999, which is not a finite number"),
        ("working_voxel", "1" * 400, "a number of 400 digits"),
        ("provenance", "1" * 5000, "a number of 5000 digits"),
        ("provenance", "[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ("provenance", '{"a":' * 100_000, "nested too deeply"),
        ("provenance", '{"a": 1, "a": 2}', "the key 'a' twice"),
        ("provenance", "{", "which is not JSON"),
    ],
)
def test_numbers_that_are_none_and_texts_that_are_bombs(tmp_path: Path, where: str, text: str, said: str) -> None:
    assert said in refused(tmp_path / "fit.json", broken(where, text))


def test_bytes_that_are_no_utf8_and_a_byte_order_mark(tmp_path: Path) -> None:
    text = made_fit().to_json()
    assert "not text in UTF-8" in refused(tmp_path / "fit.json", text.replace("tubes", "tübes").encode("latin-1"))
    assert "not text in UTF-8" in refused(tmp_path / "fit.json", text.encode("utf-16"))
    (tmp_path / "fit.json").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert Fit.load(tmp_path / "fit.json").mass == made_fit().mass


def test_content_that_is_no_object_and_another_format(tmp_path: Path) -> None:
    for text in ("[]", "7", '"x"', "null", "{}"):
        assert "expected a fit.json written by `curvafit infer` with" in refused(tmp_path / "fit.json", text)
    said = refused(tmp_path / "fit.json", json.dumps({"format": ["x" * 10**6] * 100}))
    assert "expected a fit.json of format curvafit-fit-3, got [" in said


def test_what_is_written_is_what_can_be_read() -> None:
    assert violation(made_fit().as_dict(), FIT_SCHEMA) is None
    heavy = dataclasses.replace(made_fit().candidates[0], mass=1.5)
    with pytest.raises(ValueError, match="mass"):
        dataclasses.replace(made_fit(), candidates=(heavy,)).to_json()
    with pytest.raises(ValueError, match="length_unit"):
        dataclasses.replace(made_fit(), length_unit="ell").to_json()


def test_the_schema_is_plain_data_in_the_words_that_both_checks_know() -> None:
    words = {"type", "enum", "required", "properties", "items", "minItems", "minimum", "maximum", "description"}

    def walk(schema: dict) -> None:
        assert set(schema) <= words | {"exclusiveMinimum", "exclusiveMaximum"} and "description" in schema
        for inner in [*schema.get("properties", {}).values(), *([schema["items"]] if "items" in schema else [])]:
            walk(inner)

    walk(FIT_SCHEMA)
    assert json.loads(json.dumps(FIT_SCHEMA)) == FIT_SCHEMA


def test_a_quotation_is_short() -> None:
    bomb: list = ["x"]
    for _ in range(40):
        bomb = [bomb] * 9
    loop: list = []
    loop.append(loop)
    for value in (bomb, loop, "y" * 10**6, {str(k): "z" * 999 for k in range(999)}, 7**400, b"\n" * 10**5):
        assert len(quoted(value)) < 200 and "\n" not in quoted(value)
