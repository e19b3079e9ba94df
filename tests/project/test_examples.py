"""The example scripts, each through its main at a tiny size: a table that makes sense, a picture, kept shapes."""

import contextlib
import importlib
import re
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

from curvafit.geometry.mesh import surface
from curvafit.priors.law import preset
from curvafit.scan.tiles import measure

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.delenv("CURVAFIT_DATA", raising=False)
    monkeypatch.setattr(importlib.import_module("common"), "PIXELS", 60)
    return importlib.import_module


@pytest.fixture
def run(script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[str]]:
    """Run a script with options, check its files, and give the table's lines under the head."""

    def ran(name: str, *options: object) -> list[str]:
        monkeypatch.setattr(sys, "argv", [name, *map(str, options), "-o", str(tmp_path)])
        script(name).main()
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        lines = (tmp_path / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        head = [line for line in lines if line.startswith("#")]
        assert "seed 0" in head[0] and "steps=" in head[1] and "curvafit" in head[2] and "commit" in head[2]
        return lines[len(head) :]

    return ran


def numbers(line: str) -> list[float]:
    """What of a line are numbers."""
    found = []
    for word in line.replace("%", "").replace(",", " ").split():
        with contextlib.suppress(ValueError):
            found.append(float(word))
    return found


def test_convergence(run) -> None:
    """And orientation's table."""
    _, *rows, status = run("convergence", "--edge", 24, "--schedule", "fast", "--steps", 300)
    steps, energies, *_ = zip(*map(numbers, rows), strict=True)
    assert steps == (10, 30, 100, 300)
    assert all(a > b for a, b in pairwise(energies))
    assert numbers(rows[-1])[-1] == 0 and 0.02 < numbers(rows[-1])[-2] < 0.4
    assert "after 300 steps" in status
    _, *rows = run("orientation", "--edge", 32, "--steps", 120)
    free_tubes, tubes, free_layers, layers, *turning = map(numbers, rows)
    assert [free_tubes[0], tubes[0], free_layers[0], layers[0]] == [0, 1000, 0, 800]
    assert tubes[1] < free_tubes[1] and layers[1] < free_layers[1] < 1
    assert max(lean for _, lean, *_ in turning) < 0.3


@pytest.mark.parametrize(("name", "size"), [("gallery", 28), ("interpolation", 28), ("spatialised", 20)])
def test_a_script_makes_its_table(run, script, monkeypatch: pytest.MonkeyPatch, name: str, size: int) -> None:
    if name == "gallery":
        monkeypatch.setattr(script(name), "NAMES", ("tubes", "exp-0366"))
    head, *rows = run(name, "--edge", size, *(("--count", 3) if name == "interpolation" else ()), "--steps", 150)
    assert len(rows) > 1 and all(numbers(row) for row in rows[:-1]), (head, rows)


def test_interpolated_parameters(script) -> None:
    between = script("interpolation").between
    layers, spheres, tubes, sponges = (preset(f"bilinear-{n}") for n in ("layers", "spheres", "tubes", "sponges"))
    for place, corner in {(0, 0): layers, (0, 1): spheres, (1, 1): tubes, (1, 0): sponges}.items():
        assert between(*place) == (corner.coefficients, pytest.approx(corner.mass))
    a, mass = between(0, 0.25)
    assert a.a00 == pytest.approx(0.25 * 937.5) and mass == pytest.approx(0.75 * -0.3 + 0.25 * -0.6)
    place = np.broadcast_to(np.cos(2 * np.pi * np.arange(24) / 24)[:, None, None], (24, 24, 24))
    lean = script("orientation").lean
    assert lean(place) == pytest.approx(1, abs=1e-6)
    assert lean(np.swapaxes(place, 0, 2)) == pytest.approx(0, abs=1e-6)
    a, mass = script("spatialised").maps(21)
    assert a.a20.shape == mass.shape == (1, 1, 6 * 21)
    for k, number in enumerate((1, 1, 2, 3, 4, 4)):
        stated = preset(f"spatial-{number}")
        assert [float(value[0, 0, 21 * k + 10]) for value in a] == pytest.approx([*stated.coefficients])
        assert float(mass[0, 0, 21 * k + 10]) == pytest.approx(stated.mass)
    ends = mass[0, 0, 0] + mass[0, 0, -1], mass[0, 0, 20] + mass[0, 0, 21], mass[0, 0, 41] + mass[0, 0, 42]
    assert [float(end) / 2 for end in ends] == pytest.approx([-0.55, -0.4, -0.5])


def test_the_gallerys_range_has_the_laws_of_its_strip(script) -> None:
    """`docs/assets/turn.js` writes the numbers of laws between the page's two."""
    turning = script("turning")
    (pair,) = re.findall(
        r'<figure class="between".*?</figure>',
        (EXAMPLES.parent / "docs" / "gallery.md").read_text(encoding="utf-8"),
        re.DOTALL,
    )
    for end, name in zip(("first", "last"), turning.ENDS, strict=True):
        (stated,) = re.findall(rf'data-{end}="([^"]*)"', pair)
        law = preset(name)
        assert [float(number) for number in stated.split()] == pytest.approx([*law.coefficients, law.mass])
    assert f'data-frames="{turning.LAWS}"' in pair
    with Image.open(EXAMPLES.parent / "docs" / "gallery" / "between.webp") as strip:
        assert strip.size == (turning.LAWS * turning.PIXELS, turning.PIXELS)


def test_seeds_and_kept_shapes(run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ("--edge", 28, "--count", 3, "--steps", 150)
    lines = run("seeds", *size)
    assert "random-0000: " in capsys.readouterr().out
    for line in lines[2:4]:
        near, _, far, _, ratio = numbers(line)
        assert 0 < near < far < 30 and ratio == pytest.approx(100 * near / far, rel=0.02)
    (tmp_path / "seed-1.npz").unlink()
    assert run("seeds", *size) == lines
    made = [line for line in capsys.readouterr().out.splitlines() if " steps" in line and ".npz" not in line]
    assert [line.split(":")[0] for line in made if line.startswith(("seed-", "random-"))] == ["seed-1"]


@pytest.mark.parametrize(("name", "genus"), [("sphere", 0), ("torus", 1), ("smaller-torus", 1), ("genus-2", 2)])
def test_willmore_starts_have_their_genus(script, name: str, genus: int) -> None:
    field, grid = script("willmore").start(name, 48, 4)
    shape = surface(field, grid)
    assert trimesh.Trimesh(shape.vertices, shape.faces).euler_number == 2 - 2 * genus
    assert script("willmore").genus(SimpleNamespace(grid=grid, field=field)) == genus


def test_willmore_energy_is_extrapolated(script) -> None:
    """Energies with errors of ε² and (Δx/ε)² give what there is without."""
    willmore = script("willmore")
    rows = []
    for edge, width in ((15, 4), (20, 5), (20, 4)):
        field, grid = willmore.start("sphere", edge, width)
        ε, flow = width * grid.spacing[0], SimpleNamespace(grid=grid, field=field)
        rows.append(willmore.Row(ε, 50 + 3 * ε**2 - 7 / width**2, 0.0, 0.0, flow))
    assert willmore.extrapolated(rows) == pytest.approx(50, abs=1e-9)


def test_willmore(script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    options = ["--cases", "sphere", "--scale", "0.3", "--steps", "3", "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["willmore", *options])
    script("willmore").main()
    _, *rows, _, area = (tmp_path / "willmore.txt").read_text(encoding="utf-8").splitlines()
    assert [numbers(row.split(")")[1])[1] for row in rows] == pytest.approx([16 * np.pi] * 3, rel=0.09)
    assert numbers(area)[0] == pytest.approx(4 * np.pi * 0.66**2, rel=0.1)
    assert (tmp_path / "sphere.png").read_bytes().startswith(b"\x89PNG")


def test_pictures_of_filling(script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", ["helps", "--small", "-o", str(tmp_path)])
    script("helps").main()
    names = ("helps_better", "helps_equal", "helps_not", "filled")
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.webp" for name in names}
    script("pictures").write_webp(tmp_path / "filled.webp", tmp_path / "small.webp", width=130)
    with Image.open(tmp_path / "small.webp") as small, Image.open(tmp_path / "filled.webp") as large:
        assert small.size == (130, round(130 * large.height / large.width)) and small.format == "WEBP"


def test_bone(script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two groups that measure as their laws do, scanned alike, and the picture of the page."""
    bone = script("bone")
    monkeypatch.setattr(bone, "GROUPS", {name: (law, animals[:2]) for name, (law, animals) in bone.GROUPS.items()})
    words = ["bone", "--edge", "40", "--picture", str(tmp_path / "bone.webp"), "-o", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    bone.main()
    scans = [measure(tmp_path / group / f"mouse{k}.tif") for group, k in (("control", 1), ("treated", 5))]
    assert scans[0]["BV/TV"].value > scans[1]["BV/TV"].value > 0.1 and scans[0].unit == "mm"
    with Image.open(tmp_path / "bone.webp") as picture:
        assert picture.width == 1000
