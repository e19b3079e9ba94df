"""F_ε as a training loss: of a predicted segmentation (`CurvaturePrior`), with another loss, and as a function."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from curvafit.core.checks import check_choice, check_float, check_int, quoted
from curvafit.core.units import METRES, convert_length
from curvafit.priors.coefficients import POWERS, Coefficients, check_strengths
from curvafit.priors.grid import WORKING_EPSILON, Float, Grid
from curvafit.priors.kernels.differentiable import energies
from curvafit.priors.law import Law, LawLike
from curvafit.priors.profile import refine_profile

#: Voxels that ε spans; an axis on which it spans fewer, by more than a tenth, is refined, at most `FINEST`-fold.
RESOLVED, FINEST = 2, 16
#: Voxels are at most so many ε long if their energy, interpolated, is to be that of fine ones within a fifth.
LONGEST = 2.05
#: The greatest ε in voxels of the smallest edge; no window is longer.
COARSEST = 10_000
#: The greatest value of a mask whose products float32 holds.
HEAVIEST = 1e9
_Values = TypeVar("_Values", bound=Tensor | None)


class CurvaturePrior(nn.Module):
    """The energy F_ε of a segmentation, as a loss with the keywords of MONAI's.

    `forward(input, target=None, mask=None)` takes an `input` `(B, N, D, H, W)` of N classes and returns a scalar, or
    `(B, N, 1, 1, 1)` with `reduction="none"`. It computes in float32 under autocast too; float64 input stays float64.
    The target states only which voxels to ignore. The mask holds weights of voxels from 0, in the input's shape or with
    1 for B or N. The loss is deterministic, and a constant or saturated input has a finite value and gradient. Float32
    has first derivatives in reverse mode, as a training takes them; second ones, forward mode and `torch.func` need
    float64, or raise a RuntimeError.

    Parameters
    ----------
    law
        `Coefficients` with lengths in spacing's unit; a `Law`, or a preset's name, in working units, where the smallest
        voxel edge is 0.01; the path of a `fit.json`, or a fit. A warning says where a fit is not `Supported`.
    sigmoid, softmax
        Whether the input is logits, to which this function is applied first. Else it is probabilities, and a warning
        says where it has other values.
    include_background
        Whether channel 0 counts.
    to_onehot_y
        Whether the target is class numbers `(B, 1, D, H, W)`.
    reduction
        `"mean"` over batch and classes; `"none"`; or `"sum"` of the energies F_ε, not normalised, so that windows that
        overlap by 2·border voxels add up to the interior of the whole (border 2 across an axis that is interpolated,
        and along it nearly: the spline sees the whole axis).
    ignore_index
        Voxels where the target has this value do not count and get no gradient, whatever their values, NaN too. Nor do
        voxels within `border` of them count, or within 1: their neighbours are unknown, as at the input's faces.
    spacing
        Voxel edges (z, y, x), or one edge for all axes.
    unit
        Spacing's unit (nm, um, mm or m) where the `fit.json` has another one; the fit is then converted. A warning says
        where ε differs from the fit's by more than a factor of four, and where a unit changes nothing: a preset has no
        lengths of its own.
    epsilon
        ε in spacing's unit; twice the smallest edge by default. Structures thinner than twice the smallest edge do not
        survive. An axis on which ε spans fewer than two voxels, by more than a tenth, is interpolated, and a warning
        says so. Up to voxels as long as ε the energy is that of fine ones within 4 %, up to 2 ε within 20 %; where they
        are longer it is up to 3 times larger, and the warning says that. A refinement of more than 16-fold is refused,
        and so is an ε longer than the window.
    border
        Number of voxels at each face of the input that do not count, since their neighbours are unknown.
    shape
        Voxels (D, H, W) of a whole patch. An input of another shape is then the same patch on a coarser grid, as in
        deep supervision, with a larger spacing. The loss is zero on a level that has no interior or would need a
        refinement of more than 16-fold.
    """

    def __init__(
        self,
        law: LawLike,
        *,
        sigmoid: bool = False,
        softmax: bool = False,
        include_background: bool = True,
        to_onehot_y: bool = False,
        reduction: str = "mean",
        ignore_index: int | None = None,
        spacing: float | Sequence[float] = 1.0,
        unit: str | None = None,
        epsilon: float | None = None,
        border: int = 1,
        shape: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        if sigmoid and softmax:
            raise ValueError("expected sigmoid or softmax, got both")
        check_choice(reduction, ("mean", "sum", "none"), "a reduction 'mean', 'sum' or 'none'")
        self.sigmoid, self.softmax, self.reduction = sigmoid, softmax, reduction
        self.include_background, self.to_onehot_y, self.ignore_index = include_background, to_onehot_y, ignore_index
        patch = Grid((4, 4, 4) if shape is None else shape, spacing)  # type: ignore[arg-type]
        self.spacing, self.shape = patch.spacing, None if shape is None else patch.shape
        edge = min(self.spacing)
        epsilon = RESOLVED * edge if epsilon is None else epsilon
        self.epsilon = check_float(epsilon, "epsilon > 0 in spacing's unit", math.ulp(0), COARSEST * edge)
        self.border = check_int(border, "a border of whole voxels from 0", 0, 2**31)
        self._warned: set[str] = set()
        law = Law.of(law)
        self.coefficients, self._origin = _read_coefficients(law, edge, unit, self.epsilon), law.origin
        if unit is not None and law.working and not law.fitted:
            warnings.warn(f"a unit changes nothing for {law.origin}: its lengths follow the voxel edge", stacklevel=2)
        refinement, longest = choose_refinement(self.spacing, self.epsilon), max(self.spacing)
        if max(refinement) > 1:
            axes = ", ".join(f"{axis} {n}-fold" for axis, n in zip("zyx", refinement, strict=True) if n > 1)
            message = f"ε = {self.epsilon:g} spans fewer than 2 voxels: interpolating {axes}"
            if longest > LONGEST * self.epsilon:
                message += f"; voxels longer than 2 ε inflate F_ε, 3-fold at 4 ε: state an ε of {longest / 2:g} or more"
            warnings.warn(message, stacklevel=2)

    def extra_repr(self) -> str:
        """Return the settings that `repr` shows: the law, what is not the default, spacing, ε, border."""
        defaults = {"sigmoid": False, "softmax": False, "include_background": True, "to_onehot_y": False}
        defaults |= {"reduction": "mean", "ignore_index": None, "shape": None}
        shown = [f"{name}={getattr(self, name)!r}" for name, value in defaults.items() if getattr(self, name) != value]
        law = f"{self._origin} ({', '.join(f'{float(a):.6g}' for a in self.coefficients)})"
        return ", ".join((law, *shown, f"spacing={self.spacing}, epsilon={self.epsilon:g}, border={self.border}"))

    def forward(self, input: Tensor, target: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Return the loss of a batch; see the class."""
        input, target, mask = _strip_subclass(input), _strip_subclass(target), _strip_subclass(mask)
        with torch.autocast(input.device.type, enabled=False):
            mask, ignored = self._mask_voxels(input, target, mask)
            if ignored is not None:  # before the activation, as its derivative at a NaN is NaN
                input = torch.where(ignored, 0.0 if self.sigmoid or self.softmax else 0.5, input)
            probability = self._probability(input)
            if self._is_skipped(input):
                values = probability.sum((-3, -2, -1)) * 0  # zeros that have a gradient
            else:
                spacing = self._spacing_of(input)
                numbers = self.coefficients, spacing, self.epsilon, choose_refinement(spacing, self.epsilon)
                weights = None if mask is None else mask.expand_as(probability).flatten(0, 1)
                options = {"normalize": self.reduction != "sum", "border": self.border}
                energies = _measure_window(probability.flatten(0, 1), *numbers, weights, **options)
                values = energies.unflatten(0, probability.shape[:2])
            if self.reduction == "none":
                return values[..., None, None, None]
            return values.sum() if self.reduction == "sum" else values.mean()

    def suggest_weight(
        self, loss_fn: Callable[[Tensor, Tensor], Tensor], batch: tuple[Tensor, Tensor], share: float = 1.0
    ) -> float:
        """Return the weight with which this loss's gradient has `share` times the norm of that of another loss.

        Both gradients are with respect to the input. The batch is a network's output and its target, as in training;
        `loss_fn` is the other loss, a function of the two whose values are summed. At the default ε, tubes two voxels
        thick survive a share of 0.1 with `trabec` and `tubes`, but not with `pearls`; a share of 1 removes them.

        Raises ValueError where either gradient is zero or not finite, as on a prediction without a surface.
        """
        output, target = batch
        leaf = output.detach().float().requires_grad_()
        norms = []
        for loss in (loss_fn, self):
            with torch.enable_grad():
                (gradient,) = torch.autograd.grad(loss(leaf, target).sum(), leaf)
            norms.append(float(gradient.double().norm()))
        if not all(0 < norm < math.inf for norm in norms):
            raise ValueError(f"expected a batch on which both losses have a gradient, got norms {norms[0]}, {norms[1]}")
        return share * norms[0] / norms[1]

    def _probability(self, input: Tensor) -> Tensor:
        """Return probabilities (B, classes that count, D, H, W) in float32 or float64."""
        if input.dim() != 5 or not input.is_floating_point() or 0 in input.shape:
            raise ValueError(f"expected an input of floats (B, N, D, H, W), got {input.dtype} {tuple(input.shape)}")
        values = input if input.dtype == torch.float64 else input.float()
        if self.sigmoid:
            values = values.sigmoid()
        elif not self.softmax or input.shape[1] == 1:
            self._check_range(values)
        if input.shape[1] == 1:
            options = {"softmax=True": self.softmax, "include_background=False": not self.include_background}
            for name, active in options.items():
                if active:
                    warnings.warn(f"single channel prediction, `{name}` ignored.", stacklevel=3)
            return values
        if self.softmax:
            values = values.softmax(1)
        return values if self.include_background else values[:, 1:]

    def _mask_voxels(
        self, input: Tensor, target: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        """Check mask and target; return the mask (B or 1, classes that count or 1, D, H, W), with zeros on and around
        ignored voxels, and these voxels (B, 1, D, H, W); None where all voxels count, or none can be ignored."""
        batch, classes = input.shape[:2]
        space = tuple(input.shape[2:])
        if mask is not None:
            valid = mask.dim() == 5 and mask.shape[0] in (1, batch) and mask.shape[1] in (1, classes)
            if not valid or tuple(mask.shape[2:]) != space:
                expected = f"({batch} or 1, {classes} or 1, {', '.join(map(str, space))})"
                raise ValueError(f"expected a mask of shape {expected}, got {tuple(mask.shape)}")
            if _read_number(((mask >= 0) & (mask <= HEAVIEST)).all()) == 0:
                raise ValueError(f"expected a mask of finite numbers from 0, at most {HEAVIEST:g}, got others")
            if mask.shape[1] > 1 and not self.include_background:
                mask = mask[:, 1:]
        labels = self.to_onehot_y or self.ignore_index is not None  # else the target may have a channel for each class
        if target is not None:
            valid = target.dim() == 5 and target.shape[0] == batch and tuple(target.shape[2:]) == space
            if not valid or (labels and target.shape[1] != 1):
                raise ValueError(f"expected a target of shape {(batch, 1, *space)}, got {tuple(target.shape)}")
        if self.ignore_index is None:
            return mask, None
        if target is None:
            raise ValueError(f"ignore_index needs a target with label {self.ignore_index} on ignored voxels, got none")
        ignored, radius = target == self.ignore_index, max(1, self.border)
        counted = nn.functional.max_pool3d(ignored.float(), 2 * radius + 1, 1, radius) == 0
        return (counted if mask is None else mask * counted), ignored

    def _spacing_of(self, input: Tensor) -> tuple[float, float, float]:
        """Return the voxel edges of an input, which are larger than the patch's where the input has fewer voxels."""
        if self.shape is None:
            return self.spacing
        pairs = zip(self.spacing, self.shape, input.shape[2:], strict=True)
        return tuple(h * whole / n for h, whole, n in pairs)  # type: ignore[return-value]

    def _is_skipped(self, input: Tensor) -> bool:
        """Return whether an input is a level of deep supervision without an interior or too coarse for ε; then warn."""
        space = tuple(input.shape[2:])
        if self.shape is None or space == self.shape:
            return False
        refinement = RESOLVED * max(self._spacing_of(input)) / self.epsilon
        if refinement <= FINEST + 1e-3 and min(space) >= max(4, 2 * self.border + 1):
            return False
        self._warn(str(space), f"a level of {space} voxels is too coarse for ε = {self.epsilon:g}, so its loss is 0")
        return True

    def _check_range(self, probability: Tensor) -> None:
        """Warn once where probabilities are outside [0, 1]."""
        if torch.compiler.is_compiling() or "range" in self._warned:
            return
        low, high = (_read_number(value) for value in probability.detach().aminmax())
        if low is not None and high is not None and not (low >= -1e-3 and high <= 1 + 1e-3):
            self._warn("range", f"expected probabilities, got {low:g} to {high:g}: is sigmoid or softmax missing?")

    def _warn(self, subject: str, message: str) -> None:
        """Warn about a subject, once."""
        if not torch.compiler.is_compiling() and subject not in self._warned:
            self._warned.add(subject)
            warnings.warn(message, stacklevel=3)


class CombinedLoss(nn.Module):
    """base(input, target) + weight × prior(input, target), where the prior's weight grows over the first calls.

    Weight, warm-up and the number of calls are part of the state: a resumed training goes on with them.

    Parameters
    ----------
    base
        Any loss of an input and a target, a module or a function.
    prior
        A `CurvaturePrior` that takes the same input.
    weight
        See `CurvaturePrior.suggest_weight`.
    warmup
        Number of calls over which the weight grows linearly to its full value. Calls in evaluation mode or without a
        gradient do not count.

    Attributes
    ----------
    parts
        The terms of the last call, to log: `base`, `prior` before weighting, and the prior's `weight`, as tensors
        without a gradient on the device of the loss. Empty before the first call.
    """

    calls: Tensor

    def __init__(
        self, base: Callable[[Tensor, Tensor], Tensor], prior: nn.Module, weight: float = 1.0, warmup: int = 0
    ) -> None:
        super().__init__()
        self.weight = check_float(weight, "a finite weight from 0", 0)
        self.warmup = check_int(warmup, "a warm-up of a whole number of calls from 0", 0, 2**53)
        self.base, self.prior = base, prior
        self.parts: dict[str, Tensor] = {}
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def get_extra_state(self) -> Tensor:
        """Return weight and warm-up, for `state_dict`."""
        return torch.tensor([float(self.weight), self.warmup], dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Take weight and warm-up, from `load_state_dict`."""
        self.weight, self.warmup = float(state[0]), int(state[1])

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the weighted sum; `mask` is passed to the prior."""
        if self.training and torch.is_grad_enabled():
            self.calls += 1
        weight = self.weight
        if self.warmup:
            weight = weight * (self.calls / self.warmup).clamp(max=1)
        base, prior = self.base(input, target), self.prior(input, target, mask)
        self.parts = {"base": base.detach(), "prior": prior.detach(), "weight": torch.as_tensor(weight)}
        return base + weight * prior


def curvature_prior(
    probability: Float[Tensor, "batch z y x"],
    law: LawLike,
    spacing: tuple[float, float, float],
    epsilon: float,
    *,
    mask: Float[Tensor, "#batch z y x"] | None = None,
    normalize: bool = True,
    border: int = 1,
) -> Float[Tensor, " batch"]:
    """Return F_ε(2p - 1) of probabilities in a window of a larger volume (paper, eq. 20), by fused kernels in float32.

    Parameters
    ----------
    probability
        Values in [0, 1]; float32, or float64, which takes the definition in plain torch.
    law
        `Coefficients` in spacing's unit, a preset's name, or a fit or its path, as in `CurvaturePrior`.
    spacing, epsilon
        Voxel edges (z, y, x), and ε in their unit. An axis whose voxels are longer than .55 ε is interpolated
        (`refine_profile`) until they are ε / 2 or shorter.
    mask
        Weights of the energy's density.
    normalize
        Whether to return the mean density over the mask, in units of ε (F_ε ε³ / volume), instead of F_ε itself.
    border
        Number of voxels at each side of the window whose density does not count.

    Raises ValueError where the window is too small for its border or ε, a coefficient is too large for float32, or an
    axis would be refined more than 16-fold.
    """
    refinement = choose_refinement(spacing, epsilon)
    a = Law.of(law).in_unit(None, min(spacing))
    check_strengths(a, epsilon)
    return _measure_window(probability, a, spacing, epsilon, refinement, mask, normalize=normalize, border=border)


def choose_refinement(spacing: Sequence[float], epsilon: float) -> tuple[int, int, int]:
    """Return by how many times to refine each axis (z, y, x) for ε to span two voxels; 1 if it lacks at most a tenth.

    Raises ValueError where an axis would be refined more than 16-fold, or ε spans more than `COARSEST` voxels.
    """
    if not 0 < epsilon <= COARSEST * min(spacing):
        most = COARSEST * min(spacing)
        raise ValueError(f"ε must be above 0 and at most {most:g} for voxels of {tuple(spacing)}, got {epsilon:g}")
    ratios = [RESOLVED * h / epsilon for h in spacing]
    if max(ratios) > FINEST + 1e-3:  # here and below 1e-3 is for rounding: a ratio of 2.0001 is a refinement by 2
        least, remedy = RESOLVED * max(spacing) / FINEST, "state ε in spacing's unit, or a larger ε"
        expected = f"expected an ε of at least {least:g} for voxels of {tuple(spacing)}, got {epsilon:g}"
        raise ValueError(f"{expected}, for which an axis is refined more than {FINEST}-fold: {remedy}")
    z, y, x = (1 if ratio <= 1.1 else math.ceil(ratio - 1e-3) for ratio in ratios)
    return z, y, x


def _read_coefficients(law: Law, edge: float, unit: str | None, epsilon: float) -> Coefficients:
    """Return a law's coefficients with lengths in spacing's unit; warn where its fit is in doubt or had another ε."""
    coefficients = law.in_unit(unit, edge)
    check_strengths(coefficients, epsilon)
    if law.length_unit is None:
        if unit is not None and unit not in METRES:
            raise ValueError(f"expected a unit among {', '.join(METRES)}, got {quoted(unit)}")
        return coefficients
    if law.doubt:
        warnings.warn(law.doubt, stacklevel=3)
    unit = unit or law.length_unit
    fit_epsilon = convert_length(law.epsilon_physical, law.length_unit, unit)
    if not 1 / 4 <= epsilon / fit_epsilon <= 4:
        difference = f"ε is {epsilon:g} {unit} here and was {fit_epsilon:g} {unit} in the fit"
        warnings.warn(f"{difference}: state spacing and its unit if the two should be alike", stacklevel=3)
    return coefficients


def _measure_window(
    probability: Tensor, coefficients: Coefficients, spacing: tuple[float, float, float], epsilon: float,
    refinement: tuple[int, int, int], mask: Tensor | None, *, normalize: bool, border: int,
) -> Tensor:  # fmt: skip
    """Compute `curvature_prior` of checked numbers, which may be a compiler's symbols."""
    shape, least = tuple(probability.shape[1:]), max(4, 2 * border + 1)
    if min(shape) < least:
        raise ValueError(f"expected at least {least} voxels along each axis, got {shape}, which has no interior")
    longest = max(n * h for n, h in zip(shape, spacing, strict=True))
    if epsilon > longest:
        raise ValueError(f"expected an ε of at most the window's longest side, {longest:g}, got {epsilon:g}")
    u, inside = 2 * probability - 1, probability.new_zeros(shape)
    inside[tuple(slice(border, n - border) for n in shape)].fill_(1)
    weights = inside[None] if mask is None else inside * mask.to(inside)
    if max(refinement) > 1:
        u = refine_profile(u, refinement)
        for axis, n in enumerate(refinement):
            weights = weights.repeat_interleave(n, axis - 3) if n > 1 else weights
    # In working units, where ξ and the floor under the root are small, whatever the unit of length.
    unit = epsilon / WORKING_EPSILON
    edges = tuple(h / n / unit for h, n in zip(spacing, refinement, strict=True))
    grid = Grid.trusted(tuple(u.shape[1:]), edges, "replicate")
    scaled = (a * unit**power for a, power in zip(coefficients, POWERS.values(), strict=True))
    total = energies(u, scaled, grid, WORKING_EPSILON, weights)
    if not normalize:
        return total
    volume = weights.sum((-3, -2, -1)) * (grid.voxel_volume / WORKING_EPSILON**3)
    return total / volume.clamp_min(torch.finfo(volume.dtype).tiny)


def _strip_subclass(values: _Values) -> _Values:
    """Return a subclass's values (MONAI's `MetaTensor`) as a plain tensor; the subclass of `export`'s traces stays."""
    if not (values is None or isinstance(values, Tensor)):
        raise TypeError(f"expected a torch tensor, got {type(values).__name__}: torch.from_numpy makes one of an array")
    exporting = torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
    if values is None or type(values) is Tensor or exporting:
        return values
    return values.as_subclass(Tensor)  # type: ignore[return-value]


def _read_number(value: Tensor) -> float | None:
    """Return a tensor's single number, or None where it has no value: in compiled code and under `torch.func.vmap`."""
    if torch.compiler.is_compiling():
        return None
    try:
        return float(value)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return None
