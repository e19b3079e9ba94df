"""The result of a segmentation, its status, and its files: mask, picture, record, probability, labels."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from curvafit.core.files import move_together, remove, temporary_folder
from curvafit.core.records import Format, can_write, sibling
from curvafit.core.runtime import Pictured, check_memory, hold_signals
from curvafit.core.units import format_sampling
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.slices import filled_range
from curvafit.segmentation.uncertainty import doubt
from curvafit.volumes.formats.nifti import write_nifti_like
from curvafit.volumes.formats.zarr import CHUNK
from curvafit.volumes.volume import Volume
from curvafit.volumes.write import is_streamed, pick_writer, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A flow has settled where its last ten steps lower the energy by less than this fraction.
SETTLED = 0.001
#: `format` of the record beside a mask.
FORMAT = Format("curvafit-mask-1", title="the record of a mask")
#: Expected Dice below which a note says that the known slices are too few.
HALF = 0.5
#: Relative difference of the mask's volume and that by known slices below which there is no note.
LITTLE = 0.01
#: The note on a mask whose volume is not that by known slices.
OFF = (
    "The mask's share of the volume is not within the interval by the known slices alone: for a volume take theirs. "
    "The mask is the one with the best Dice to expect, which may be too large or too small."
)
_NIFTI = (".nii", ".nii.gz")


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How sure a volume between known slices is.

    Attributes
    ----------
    probability
        The probability of the inside, or of several structures that of the voxel's label, float32, with the scan's
        grid, spacing, unit and affine; 0 or 1 on known slices.
    calibration_error
        How far shares inside differ from probabilities near the surface, on average: on the example, or else on
        generated shapes that did not teach.
    suggestions
        Numbers of the slices to annotate next, the most informative first.
    expected_dice
        The Dice of the mask between known slices that the probabilities let expect; of several structures the least.
    dice_of_labels
        Of several structures: that of each label.
    known_share
        Of one structure: its share of the volume by the known slices alone, with its 95 % interval where there is one.
    mean_probability
        Of one structure: its share of the volume by the probabilities, 0 in slices that are not filled.
    entropies
        The sums of the entropies of probabilities, in nats, over the slices across z, y and x; 0 beyond the known ones.
    """

    probability: Volume
    calibration_error: float
    suggestions: tuple[int, ...]
    expected_dice: float
    dice_of_labels: Mapping[int, float] = field(default_factory=dict)
    known_share: tuple[float, ...] = ()
    mean_probability: float = math.nan
    entropies: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True, repr=False, eq=False)
class Segmentation(Pictured):
    """A mask, with its status, and its phase field and energy where a law made it.

    Attributes
    ----------
    mask, phase
        The mask, bool, and the phase field u, float32, with the scan's grid, spacing, unit and affine; no phase field
        of a volume between known slices that no law filled.
    weight
        λ, in nats per unit of F_ε; None for a reconstruction from known slices.
    coefficients, epsilon
        The coefficients of F_ε and ε, with lengths in the scan's unit; no coefficients where no prior helps.
    status
        A sentence: what a prior gained, whether the flow settled, and which share of the volume is inside.
    notes
        Sentences on the evidence and on assumptions.
    uncertainty
        Of a volume between known slices: how sure it is, and what to annotate next.
    labels
        Of several structures: the label at each voxel, a whole number, 0 where there is none.
    image
        Of a volume filled with its image: that image.
    """

    mask: Volume
    phase: Volume | None
    weight: float | None
    coefficients: Coefficients | None
    epsilon: float
    status: str
    notes: tuple[str, ...]
    uncertainty: Uncertainty | None = None
    labels: Volume | None = None
    image: Volume | None = None

    @property
    def share(self) -> float:
        """The mask's share of the volume, from 0 to 1."""
        slabs = (self.mask.read((slice(z, z + 1), slice(None), slice(None))) for z in range(self.mask.shape[0]))
        return sum(np.count_nonzero(slab) for slab in slabs) / math.prod(self.mask.shape)

    @classmethod
    def of(
        cls,
        scan: Volume,
        mask: Any,
        phase: Any,
        law: Coefficients | None,
        epsilon: float,
        notes: tuple[str, ...],
        **more: Any,
    ) -> Segmentation:
        """Return a segmentation whose mask and phase field (Z, Y, X), or None, lie as the scan does; `more` are
        attributes."""
        inside = replace(scan, array=mask, notes=())
        field = None if phase is None else replace(scan, array=phase, notes=())
        return cls(inside, field, coefficients=law, epsilon=epsilon, notes=(*scan.notes, *notes), **more)

    @property
    def probability(self) -> Volume | None:
        """The probability of the inside, of a volume between known slices."""
        return None if self.uncertainty is None else self.uncertainty.probability

    def __repr__(self) -> str:
        size = format_sampling(self.mask.shape, self.mask.spacing, self.mask.unit)
        return f"Segmentation({size}: {self.status})"


def flow_summary(share: float, energy: Sequence[float] = (), steps: int = 0) -> str:
    """Return the part of a status on whether a flow settled, if there was one, and the fraction inside (`share`)."""
    inside = f"{100 * share:.2f} % of the volume is inside"
    if not steps:
        return inside
    duration = f"{steps} step" if steps == 1 else f"{steps} steps"
    if share in (0.0, 1.0):
        return f"no surface is left after {duration}: the prior is too strong for the data, lower its weight"
    change = (energy[0] - energy[-1]) / max(abs(energy[-1]), 1e-30) if len(energy) > 1 else 1.0
    return f"{'settled' if abs(change) < SETTLED else 'still moving'} after {duration}: {inside}"


def check_mask_target(
    path: str | Path,
    scan: Volume | None = None,
    inputs: Iterable[str | Path] = (),
    overwrite: bool = False,
    *,
    probability: bool = False,
) -> Path:
    """Return the path, or raise ValueError where the mask of a scan cannot be written there; to be called before the
    work. None of the `inputs`, files or folders, may be overwritten. `overwrite` says whether files of other origin may
    be replaced, `probability` whether it goes beside the mask."""
    target = Path(path)
    more = [sibling(target, ".json"), sibling(target, ".png"), *([probability_path(target)] if probability else [])]
    can_write(target, FORMAT, more=more, inputs=inputs, overwrite=overwrite)
    pick_writer(target, "mm" if scan is None else scan.unit)
    if scan is not None and not is_streamed(target):
        check_memory(scan.shape, 4, "a result that is not written into Zarr")
    return target


def hidden_store(target: Path) -> Path:
    """Return the folder for finished parts of a run, beside a mask."""
    return target.with_name(f".{target.name}.curvafit-tiles")


def write_mask(
    segmentation: Segmentation,
    scan: Volume,
    path: str | Path,
    *,
    like: str | Path | None = None,
    unit: str | None = None,
    record: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write the mask (0 and 1, uint8) or labels, a picture, a record, and the probability where there is one.

    The files `mask.nii.gz`, `mask.png`, `mask.json` and `mask_probability.nii.gz` appear together once all are whole;
    their paths are returned. A former probability is removed.

    Where the scan's file, `like`, and the target are NIfTI, the mask gets the same header but for type and range, and
    `unit`. `record` has entries to add to the record; with `overwrite` files of other origin may be replaced.
    """
    probability = segmentation.probability
    inputs = () if like is None else (like,)
    target = check_mask_target(path, scan, inputs, overwrite, probability=probability is not None)

    def write(volume: Volume, file: Path) -> None:
        if like is not None and all(str(path).lower().endswith(_NIFTI) for path in (like, target)):
            write_nifti_like(volume.values, Path(like), file, unit)
        else:
            save(replace(volume, spacing=scan.spacing, unit=scan.unit, affine=scan.affine), file, kind=FORMAT.name)

    with temporary_folder(sibling(target, ".json")) as work:
        mask, labels = segmentation.mask, segmentation.labels
        if labels is None:  # the mask, as 0 and 1
            numbers = replace(mask.array, label=None) if mask.in_file else mask.values.view(np.uint8)
            labels = replace(mask, array=numbers)
        if probability is not None:
            write(probability, work / probability_path(target).name)
        write(labels, work / target.name)
        rows = {} if probability is not None else {"scan": (scan.values, None), "mask": (scan.values, mask.values)}
        content = describe_run(segmentation, record or {}, scan)
        return _finish(work, target, probability is not None, _figure(segmentation, rows), content)


def _finish(work: Path, target: Path, probable: bool, figure: Figure, content: dict[str, Any]) -> tuple[Path, ...]:
    """Write picture and record into the folder `work`, where the mask is, and its probability if `probable`; move all
    files at once to the target's folder, remove the probability of an earlier run, and return the paths."""
    from curvafit.drawing.plot import DPI

    record, picture, former = sibling(target, ".json"), sibling(target, ".png"), FORMAT.companions(target)
    probability = probability_path(target)
    names = [target.name, picture.name, record.name, *([probability.name] if probable else [])]
    figure.savefig(work / picture.name, dpi=DPI)
    FORMAT.write(work / record.name, {**content, "files": names})
    with hold_signals():
        files = move_together([work / name for name in names], target.parent)
        if not probable and probability.name in former:
            remove(probability)
    return files


def segmentation_figure(segmentation: Segmentation) -> Figure:
    """Draw the mask's outline on the phase field, in the middle slices or the most uncertain ones."""
    mask, phase = segmentation.mask, segmentation.phase
    return _figure(segmentation, {} if phase is None else {"mask": (phase.values, mask.values)})


def _figure(segmentation: Segmentation, rows: Mapping[str, tuple[np.ndarray, np.ndarray | None]]) -> Figure:
    """Draw `rows` of middle slices. Of a volume between known slices draw the most uncertain ones instead: the outline
    over the image, if there is one, or else over the known voxels, and the entropy below."""
    from curvafit.drawing.plot import Sections, colour_labels, draw_sections, grey_limits, section_figure

    mask, labels, image = segmentation.mask, segmentation.labels, segmentation.image
    if (uncertain := segmentation.uncertainty) is None:
        return section_figure(rows, mask.spacing, mask.unit)
    places = [int(sums.argmax()) for sums in uncertain.entropies]
    masks, likely = _read_planes(mask, places), _read_planes(uncertain.probability, places)
    entropies, sections = [doubt(plane) for plane in likely], {}
    if image is not None:
        sections["image, filled"] = Sections(_read_planes(image, places), masks, grey_limits(image.values))
    elif labels is None:  # known voxels have a probability of exactly 0 or 1
        known = [np.where(p % 1 == 0, 2 * m.astype(np.int8) - 1, 0) for p, m in zip(likely, masks, strict=True)]
        sections["known, filled"] = Sections(known, masks, (-1.0, 1.0))
    if labels is not None:
        colours = [colour_labels(plane) for plane in _read_planes(labels, places)]
        sections["filled"] = Sections(colours, None, (0.0, 1.0))
    limits = grey_limits(np.concatenate([plane.ravel() for plane in entropies]))
    sections["how unsure"] = Sections(entropies, masks, limits)
    return draw_sections(sections, mask.spacing, mask.unit, places)


def _read_planes(volume: Volume, places: Sequence[int]) -> list[np.ndarray]:
    """Return the slices of a volume at three `places`, across z, y and x."""
    planes = []
    for axis, place in enumerate(places):
        box = [slice(0, n) for n in volume.shape]
        box[axis] = slice(place, place + 1)
        # A plane across y or x has a voxel in each page of a mapped file: it is read a few slices at once.
        slabs = [slice(z, z + CHUNK) for z in range(0, volume.shape[0], CHUNK)] if axis else box[:1]
        planes.append(np.concatenate([volume.read((slab, box[1], box[2])) for slab in slabs]).squeeze(axis))
    return planes


def probability_path(target: Path) -> Path:
    """Return the path of the probability beside a mask: `mask_probability.nii.gz` for `mask.nii.gz`."""
    return sibling(target, f"_probability{target.name.removeprefix(sibling(target, '').name)}")


def describe_run(segmentation: Segmentation, options: Mapping[str, Any], scan: Volume) -> dict[str, Any]:
    """Return the record of a scan's segmentation: its status, the run's options, figures and notes."""
    uncertain, figures = segmentation.uncertainty, {}
    if uncertain is not None:
        figures = {name: getattr(uncertain, name) for name in ("calibration_error", "suggestions", "expected_dice")}
        if uncertain.dice_of_labels:
            figures["dice_of_labels"] = {str(number): dice for number, dice in uncertain.dice_of_labels.items()}
        if uncertain.known_share:
            figures |= {"known_share": uncertain.known_share, "mean_probability": uncertain.mean_probability}
    return {
        "status": segmentation.status,
        **options,
        "scan": scan.source,
        "shape": list(scan.shape),
        "spacing": list(scan.spacing),
        "unit": scan.unit,
        "coefficients": None if segmentation.coefficients is None else segmentation.coefficients.as_dict(),
        "epsilon": segmentation.epsilon,
        "weight": segmentation.weight,
        "volume_fraction": segmentation.share,
        **figures,
        "notes": list(segmentation.notes),
        "curvafit": version("curvafit"),
        "torch": version("torch"),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def describe_filled(
    head: str, inside: str, share: float, uncertain: Uncertainty, places: Sequence[int], length: int, *, tested: str,
    image: bool = False, part: float = 1.0,
) -> tuple[str, tuple[str, ...]]:  # fmt: skip
    """Return the status of a volume of `length` slices with known ones at `places`, and notes on doubts. `head` is how
    it was filled, `inside` describes the mask, `share` is its fraction of the volume, `tested` names what probabilities
    were tested on, and shares are stated of a volume that this is a `part` of. With an image all slices are filled."""
    filled = slice(0, length) if image else filled_range(places, length)
    unfilled = length - (filled.stop - filled.start)
    known = uncertain.known_share
    beyond = f", {unfilled} beyond them not filled" if unfilled > 0 else ""
    percent = 100 * part
    span = f" ({percent * known[1]:.2f} to {percent * known[2]:.2f})" if known[1:] else ""
    status = (
        f"{head}: {len(places)} of {length} slices known{beyond}, {inside}, "
        f"{percent * known[0]:.2f} %{span} by known slices alone, {percent * uncertain.mean_probability:.2f} % by "
        f"probabilities; expect a Dice of {uncertain.expected_dice:.2f} between known slices; "
        f"probabilities err by {uncertain.calibration_error:.3f} near the surface of {tested}"
    )
    if uncertain.suggestions:
        status += f"; annotate next: {', '.join(map(str, uncertain.suggestions))}"
    few = "Known slices lie too far apart: what lies between them is more unknown than known."
    notes = [few] if uncertain.expected_dice < HALF else []
    if known[1:] and not known[1] <= share <= known[2] and abs(share / known[0] - 1) > LITTLE:
        notes.append(OFF)
    return status, (*notes, *_note_ends(places, length, filled, image))


def _note_ends(places: Sequence[int], length: int, filled: slice, image: bool) -> Iterator[str]:
    """Yield notes on the slices before the first known one and beyond the last."""
    before, beyond = places[0] - filled.start, filled.stop - 1 - places[-1]
    ends = (("Before the first", before, filled.start), ("Beyond the last", beyond, length - filled.stop))
    content = "told by the image alone" if image else "as that one is"
    for position, count, unfilled in ends:
        rest = f"; {unfilled} further away {'are' if unfilled > 1 else 'is'} not filled" if unfilled else ""
        if count or unfilled:
            yield f"{position} known slice: {count} slice{'s' * (count != 1)}, {content}{rest}."
