"""The loop of all flows: step and record until a reason to stop; and its checkpoints, so that a run survives a kill."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from curvafit.core.checks import check_open_interval
from curvafit.core.files import remove_leftovers, write_content
from curvafit.core.runtime import hold_signals
from curvafit.generation.problem import Cost
from curvafit.generation.result import RECORD_EVERY, Callback, Flow, History, State, Viability, viability
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import Stepper
from curvafit.priors.coefficients import Coefficients

#: A flow is called converged where its energy changes by less than this share over the last tenth of the steps.
SETTLED = 0.01
#: Share of the steps after which corrections begin: before, the sign of u says little about a shape's volume.
FRACTION_BEGIN = 0.2
#: Share of the shortfall that one correction adds, in a flow of at most `FRACTION_GAIN_STEPS` steps: in a longer
#: flow the shape responds more slowly, and there are more corrections.
FRACTION_GAIN, FRACTION_GAIN_STEPS = 0.1, 1000
#: The greatest distance of the mass from that of a sharp shape: it is some 0.15 in thin shapes; where it is more than
#: this, a phase is lost.
FRACTION_REACH = 0.2
#: The greatest modulus of a mass.
FRACTION_BOUND = 0.95
#: The largest constant that is added at the end to make the share exact; beyond, the share was not reached.
FRACTION_LAST = 0.1
#: First words of a checkpoint, before the SHA-256 of its content.
_HEAD = b"curvafit checkpoint 3 "


@dataclass(eq=False)
class Run:
    """The run of a shape: its stepper, what that lowers, by which steps, and options as `generate` describes them."""

    stepper: Stepper
    cost: Cost
    plan: Schedule
    callbacks: Sequence[Callback] = ()
    reject_early: bool = False
    volume_fraction: float | None = None
    seed: int | None = None

    def __post_init__(self) -> None:
        self._rows: list[list[float]] = []
        #: The reason for a stop before the plan's end, and whether a callback is the reason.
        self._stop, self._stopped_by_callback = "", False
        self._shortfall, self._failure = "", ""

    def flow(self, checkpoint: Checkpoint | None = None) -> Flow:
        """Step the shape until the plan ends, or it stops.

        It stops earlier where its energy, gradient or field is not finite, where a callback or a check stops it, and
        where the optimiser stalls. At the end the checkpoint is closed, or saved where a callback stopped the flow.
        """
        with nullcontext() if checkpoint is None else checkpoint.lock():
            self._advance(checkpoint)
        return self._describe()

    def _advance(self, checkpoint: Checkpoint | None) -> None:
        """Step until the plan ends or the shape stops, and save checkpoints."""
        stepper, plan = self.stepper, self.plan
        steps = self._resume(checkpoint)
        while True:
            # One step whose statistics are read, then those up to the next mark, without statistics.
            stepper.betas = plan.betas_at(steps)
            last = steps == plan.steps or stepper.stalled
            stepper.step(None if last else plan.rate(steps))
            if last and self._set_fraction():
                stepper.step(None)  # evaluates u with the constant that was added
            self._observe(steps, last)
            if last or self._stop:
                break
            mark = self._next_mark(steps)
            steps += 1 + stepper.run([plan.rate(step) for step in range(steps + 1, mark)])
            if checkpoint is not None and checkpoint.is_due():
                checkpoint.save(self._pack_state(steps))
        if checkpoint is not None and self._stopped_by_callback and not last:
            checkpoint.save(self._pack_state(steps + 1))  # the next step was made before the callbacks
        elif checkpoint is not None:
            checkpoint.close()

    def _resume(self, checkpoint: Checkpoint | None) -> int:
        """Restore the checkpoint's state, if there is one, and return its number of steps, else 0."""
        content = checkpoint.load() if checkpoint else None
        if content is None:
            return 0
        self.stepper.restore(content["stepper"])
        self._rows = content["rows"]
        return content["made"]

    def _pack_state(self, steps: int) -> dict[str, Any]:
        return {"made": steps, "rows": self._rows, "stepper": self.stepper.state()}

    def _next_mark(self, steps: int) -> int:
        """Return the number of steps after which the next record, check or phase of the plan is due."""
        regular = steps + RECORD_EVERY - steps % RECORD_EVERY
        checks = self.plan.checks if self.reject_early else ()
        return min(mark for mark in (regular, self.plan.steps, *self.plan.bounds, *checks) if mark > steps)

    def _set_fraction(self) -> bool:
        """Add the constant to u that makes the volume fraction exact, if it is small; return whether it was added."""
        share = self.volume_fraction
        if share is None:
            return False
        u = self.stepper.field()
        shift, end = last_shift(u, share), self._viability(u)
        if end.viable and abs(shift) <= FRACTION_LAST:
            self.stepper.shift(shift)
            return True
        self._shortfall = f"; volume fraction {float((u > 0).double().mean()):.4f} instead of {share:.4f}"
        return False

    def _observe(self, steps: int, last: bool) -> None:
        """Take the record and the viability check that are due after `steps` steps."""
        if last or steps % RECORD_EVERY == 0:
            self._record(steps, last)
        if not self._stop and self.reject_early and steps in self.plan.checks:
            check = self._viability(self.stepper.field())
            self._stop = "" if check.viable else f"stopped after {steps} of {self.plan.steps} steps: {check.reason}"

    def _describe(self) -> Flow:
        """Return the result of a run that has stopped."""
        cost, field = self.cost, self.stepper.field()
        end = self._viability(field)
        if self._failure:
            end = dataclasses.replace(end, viable=False, reason=self._failure)
        history = History(*np.array(self._rows, dtype=np.float64).T)
        status = self._describe_end(end, history)
        return Flow(
            field, history, status, cost.grid, end, self.plan, self.seed, self.stepper.mass(), cost.coefficients,
            cost.epsilon,
        )  # fmt: skip

    def _record(self, steps: int, last: bool) -> None:
        """Add a row to the history, stop where a figure is not finite, call the callbacks, and correct the mass."""
        stepper, total = self.stepper, self.plan.steps
        statistics, mass = stepper.statistics(), stepper.mass()
        self._rows.append([steps, *statistics, mass])
        figures = {"the energy": [statistics.energy], "the gradient": statistics[1:], "the field": [mass]}
        if infinite := [name for name, values in figures.items() if not all(map(math.isfinite, values))]:
            self._failure = f"{infinite[0]} is not finite"
            self._stop = f"stopped after {steps} of {total} steps: {self._failure}"
            return
        if self.callbacks:
            state = State(stepper.field(), *statistics, mass)
            stops = [bool(callback(steps, total, state)) for callback in self.callbacks]  # each one is called
            if any(stops):
                self._stop, self._stopped_by_callback = f"stopped by a callback after {steps} of {total} steps", True
        share = self.volume_fraction
        if share is not None and not last and steps >= FRACTION_BEGIN * total:
            stepper.shift(correct_mass(stepper.field(), share, mass, total))

    def _viability(self, u: Tensor) -> Viability:
        return viability(u, self.cost.grid, self.cost.epsilon)

    def _describe_end(self, end: Viability, history: History) -> str:
        """Return the sentence that says how the flow ended."""
        if self._stop:
            return self._stop
        steps = int(history.step[-1])
        if not end.viable:
            return f"no shape after {steps} steps: {end.reason}{self._shortfall}"
        if self.stepper.stalled:
            return f"stopped after {steps} steps: the line search finds no lower energy{self._shortfall}"
        earlier = history.energy[np.searchsorted(history.step, 0.9 * steps, side="right") - 1]
        fall = (earlier - history.energy[-1]) / max(abs(earlier), 1e-30)
        verdict = "converged" if abs(fall) < SETTLED else "still moving"
        change = f"the energy {'rose' if fall < 0 else 'fell'} by {100 * abs(fall):.2f} % over the last tenth"
        return f"{verdict} after {steps} steps: {change}{self._shortfall}"


# ---- a share of volume in place of a mass ----------------------------------------------------------------------------


def first_mass(share: float, mass: float | None = None) -> float:
    """Return the mass at which a flow towards a volume fraction begins: that of a sharp shape, with values ±1.

    A `mass` is taken instead, limited to `FRACTION_REACH` around it. Raises ValueError if the share is not in (0, 1).
    """
    share = check_open_interval(share, "a volume fraction in (0, 1)", 0, 1)
    sharp = min(max(2 * share - 1, -FRACTION_BOUND), FRACTION_BOUND)
    first = sharp if mass is None else min(max(mass, sharp - FRACTION_REACH), sharp + FRACTION_REACH)
    return min(max(first, -FRACTION_BOUND), FRACTION_BOUND)


def correct_mass(u: Tensor, share: float, mass: float, steps: int) -> float:
    """Return what to add to the mass, in a flow of `steps` steps, so that u's volume fraction approaches `share`."""
    shortfall = share - float(np.count_nonzero(u.numpy() > 0)) / u.numel()
    gain, sharp = min(FRACTION_GAIN, FRACTION_GAIN * FRACTION_GAIN_STEPS / steps), first_mass(share)
    # Twice, as the share of a sharp shape of mass m is (1 + m) / 2.
    target = min(max(mass + gain * 2 * shortfall, sharp - FRACTION_REACH), sharp + FRACTION_REACH)
    return min(max(target, -FRACTION_BOUND), FRACTION_BOUND) - mass


def last_shift(u: Tensor, share: float) -> float:
    """Return the constant c such that u + c is positive in round(share × voxels) voxels, at least 1 and not all."""
    outside = u.numel() - round(share * u.numel())
    rank = min(max(outside, 1), u.numel() - 1)
    # The highest value that is to be negative, and the lowest that is to be positive: zero goes to their middle.
    below, above = np.partition(u.numpy().ravel(), (rank - 1, rank))[rank - 1 : rank + 1]
    return -(float(below) + float(above)) / 2


# ---- checkpoints -----------------------------------------------------------------------------------------------------


class Checkpoint:
    """The file of one run, which is written under another name and then renamed.

    A link is followed and stays; the folder is created. `every` is the least number of seconds between two saves (0
    saves after every step), `run` the run's parameters by name (see `identity`). With `keep`, the file stays at the
    end of the run.
    """

    def __init__(self, path: str | Path, every: float, run: dict[str, str], keep: bool = False) -> None:
        self.path, self._every, self._run, self._keep = resolve_place(path), every, run, keep
        self._last_save = time.monotonic()

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the file against other runs by a file `.NAME.curvafit-lock`; raise ValueError if one uses it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lock_file = self.path.with_name(f".{self.path.name}.curvafit-lock")
        lock = FileLock(lock_file)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            message = f"the checkpoint {self.path} is in use by another run"
            raise ValueError(f"{message}: wait for it to end, or name another file") from None
        try:
            remove_leftovers(self.path)
            yield
        finally:
            with hold_signals():
                # Before the release: a process that waits for the lock then sees that its file is gone.
                with suppress(PermissionError):  # Windows deletes no file that is open
                    lock_file.unlink(missing_ok=True)
                lock.release()

    def load(self) -> dict[str, Any] | None:
        """Return the last content saved, or None where there is no file; raise ValueError if it is not this run's."""
        if not self.path.exists():
            return None
        head, _, payload = self.path.read_bytes().partition(b"\n")
        if head != _HEAD + hashlib.sha256(payload).hexdigest().encode():
            kind = "a damaged one" if head.startswith(_HEAD) else "another kind of file"
            raise ValueError(f"{self.path} is no checkpoint of a flow, but {kind}: delete it to start again")
        record = torch.load(io.BytesIO(payload), weights_only=True)
        saved, current = record["run"], self._run
        names = [name for name in {**saved, **current} if saved.get(name) != current.get(name)]
        if names:
            changes = "; ".join(f"{name} {saved.get(name)} instead of {current.get(name)}" for name in names)
            raise ValueError(f"{self.path} is the checkpoint of another run, with {changes}: delete or rename it")
        return record["content"]

    def is_due(self) -> bool:
        """Return whether it is time to save."""
        return time.monotonic() - self._last_save >= self._every

    def save(self, content: dict[str, Any]) -> None:
        """Replace the file's content, which consists of tensors, numbers, lists and dictionaries."""
        buffer = io.BytesIO()
        torch.save({"run": self._run, "content": content}, buffer)
        payload = buffer.getbuffer()
        head = _HEAD + hashlib.sha256(payload).hexdigest().encode() + b"\n"
        write_content(self.path, head, payload)
        self._last_save = time.monotonic()

    def close(self) -> None:
        """Remove the file at the end of a run, unless `keep` was set."""
        if not self._keep:
            self.path.unlink(missing_ok=True)


def resolve_place(path: str | Path) -> Path:
    """Return the file to which a checkpoint's path leads; raise ValueError for a folder, a pipe or a loop of links."""
    try:
        target = Path(path).resolve()
        regular = target.is_file() or not target.exists()
    except (OSError, RuntimeError):
        regular = False
    if not regular or (Path(path).is_symlink() and target.is_symlink()):
        raise ValueError(f"the checkpoint {path} is not a regular file: name another file")
    return target


def identity(**parts: object) -> dict[str, str]:
    """Return what must be equal for a run to resume another: its parameters as texts, tensors as digests, versions."""
    texts = {name: _to_text(value) for name, value in parts.items()}
    return {**texts, "curvafit": version("curvafit"), "torch": version("torch")}


def _to_text(value: object) -> str:
    if isinstance(value, Coefficients):
        return f"({', '.join(map(_to_text, value))})"
    if isinstance(value, Tensor):
        values = value.detach().cpu().contiguous().numpy()
        return f"{values.dtype} {values.shape} {hashlib.sha256(values.tobytes()).hexdigest()[:16]}"
    if dataclasses.is_dataclass(value) and any(isinstance(part, Tensor) for part in vars(value).values()):
        return f"{type(value).__name__}({', '.join(map(_to_text, vars(value).values()))})"
    return str(value)
