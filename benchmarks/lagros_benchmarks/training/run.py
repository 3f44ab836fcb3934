"""One training run: segments, checkpoints, and what is written at the end.

A run is cut into segments. Each has random streams and episodes of its own and ends with an
evaluation and a checkpoint, so that nothing but the checkpoint is carried from one to the next: a
run that was killed at any instant goes on after its last whole segment and, on the same machine
with the same versions, ends with the same weights to the last bit.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from lagros_benchmarks.run.files import plain, write_atomic, write_json
from lagros_benchmarks.run.surroundings import machine, versions
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.training.agent import make_agent
from lagros_benchmarks.training.curves import AXES
from lagros_benchmarks.training.settings import Training
from lagros_envs.checks import is_finite
from lagros_envs.reading import Record, check_file
from lagros_policies.learning.networks import read_safetensors

_LOG = logging.getLogger(__name__)
WEIGHTS, RECORD, CHECKPOINT = "weights.safetensors", "record.json", "checkpoint.pt"
_LONGEST = 300  # letters of what torch says of a file
_BUFFERED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Lesson(Protocol):
    """What a task adds to a run: its worlds, its figures, its file of weights."""

    venv: VecEnv

    def begin(self, segment: int) -> None:
        """Prepare the worlds for a segment, from 0."""
        ...

    def figures(self, model: BaseAlgorithm) -> dict[str, float]:
        """Return the figures of the agent on the held-out episodes of the learning curve."""
        ...

    def final(self, model: BaseAlgorithm) -> list[dict[str, Any]]:
        """Return the figures at the end, one object per condition."""
        ...

    def save(self, model: BaseAlgorithm, path: Path) -> None:
        """Write what runs without torch, as safetensors."""
        ...


@dataclass(frozen=True)
class Place:
    """Where a run is kept.

    Attributes:
        folder: Of weights, record and checkpoint, which is there while the run is not complete.
        tensorboard: Whether the run writes events to `tensorboard/` there.
    """

    folder: Path
    tensorboard: bool = False

    @property
    def weights(self) -> Path:
        """The actor."""
        return self.folder / WEIGHTS

    @property
    def record(self) -> Path:
        """The record of the complete run."""
        return self.folder / RECORD

    @property
    def checkpoint(self) -> Path:
        """The state of the run after its last segment."""
        return self.folder / CHECKPOINT


def train(
    training: Training,
    place: Place,
    lesson: Callable[[], Lesson],
    command: str = "",
    tell: Progress = untold,
) -> dict[str, Any]:
    """Train, or go on with a run that was interrupted; a complete run is only read.

    A run is complete if its weights are there as they were written; else it is made again.

    Args:
        training: The run.
        place: Where it is kept.
        lesson: Makes the task's part; called unless the run is complete.
        command: What prints the run again, for its record.
        tell: Called with the segments done and their number.

    Returns:
        The record, as it is written.

    Raises:
        ValueError: The folder holds another run, or its checkpoint is damaged.
    """
    settings = plain(training.record())
    if place.record.exists():
        complete = _complete(place, settings)
        if complete is not None:
            return complete
    made = lesson()
    model = make_agent(training, made.venv)
    curve = _restore(place.checkpoint, settings, model) if place.checkpoint.exists() else []
    if curve:
        _LOG.info("%s: going on after segment %d", place.folder, len(curve))
    # A logger of our own even without outputs: the library's makes a folder in /tmp.
    model.set_logger(Logger(None, _outputs(place, model.num_timesteps)))
    tell(training.label, len(curve), training.segments)
    for segment in range(len(curve), training.segments):
        begun = time.perf_counter(), time.process_time()
        made.begin(segment)
        _learn_segment(training, model, segment)
        figures = rounded(made.figures(model))
        curve.append(_point(model, figures, begun, curve))
        for name, value in figures.items():
            model.logger.record(f"evaluation/{name}", value)
        model.logger.dump(model.num_timesteps)
        _save(place.checkpoint, settings, model, curve)
        _LOG.info("%s %d/%d: %s", place.folder, len(curve), training.segments, _words(curve[-1]))
        tell(training.label, segment + 1, training.segments)
    model.logger.close()
    made.save(model, place.weights)
    record = plain(_record(settings, curve, made.final(model), command))
    record["weights_sha256"] = digest_of(place.weights)
    write_json(place.record, record)
    place.checkpoint.unlink(missing_ok=True)
    finished: dict[str, Any] = record
    return finished


def _complete(place: Place, settings: Any) -> dict[str, Any] | None:
    """Return the record of a run whose weights are whole, None if they are not."""
    damaged = f"delete {place.folder}"
    try:
        found = Record.load(place.record, "the record of a run")
        stored = found.record("training").entries
    except ValueError as error:
        raise ValueError(f"{error}; {damaged}") from error
    check_same(place.folder, stored, settings)
    try:
        _check_figures(found, settings["segments"])
    except ValueError as error:
        raise ValueError(f"{error}; {damaged}") from error
    record = dict(found.entries)
    try:
        read_safetensors(place.weights)
        # Records of earlier versions have no hash; the file itself has a checksum.
        if record.get("weights_sha256") not in (None, digest_of(place.weights)):
            raise ValueError(f"{place.weights} is not what this run has written")
    except (ValueError, OSError) as error:
        _LOG.warning("%s; the run is made again", error)
        return None
    return record


def _check_figures(found: Record, segments: int) -> None:
    """Check that a record has a learning curve and figures at its end.

    Raises:
        ValueError: It does not.
    """
    curve = found.record("curve")
    for axis in AXES:
        curve.array(axis, (segments,))
    for name in curve.entries:
        points = curve.list(name)
        # What is not finite is null: an effort to success where there was none.
        known = all(point is None or is_finite(point) for point in points)
        if len(points) != segments or not known:
            raise ValueError(f"{curve.name}: {name!r} must have one number for each segment")
    for index, figures in enumerate(found.list("final")):
        Record(figures, f"{found.name}: 'final' {index}")


def digest_of(path: Path) -> str:
    """Return the hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_same(folder: Path, stored: Any, settings: Any) -> None:
    """Check that a folder holds the run that was asked for.

    Raises:
        ValueError: It holds another.
    """
    if stored != settings:
        raise ValueError(
            f"{folder} holds another run ({_differences(stored, settings)}); delete it, or name "
            "another folder"
        )


def _differences(stored: Any, settings: Any) -> str:
    """Return in words in which settings a stored run differs from the one that was asked for."""
    if not isinstance(stored, dict):
        return "of settings that cannot be read"
    return ", ".join(
        f"{name} is {stored.get(name, 'missing')} there and {settings.get(name, 'missing')} here"
        for name in {**settings, **stored}
        if stored.get(name) != settings.get(name)
    )


def _outputs(place: Place, steps: int) -> list[KVWriter]:
    if not place.tensorboard:
        return []
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ImportError(
            "--tensorboard needs the package tensorboard: pip install 'lagros[rl]'"
        ) from error

    class Events(TensorBoardOutputFormat):
        """Events in which what a killed run wrote after its last checkpoint is taken back."""

        def __init__(self, folder: Path) -> None:
            self.writer = SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
            self._is_closed = False

    return [Events(place.folder / "tensorboard")]


def _learn_segment(training: Training, model: BaseAlgorithm, segment: int) -> None:
    # Fresh episodes and fresh streams: nothing but the checkpoint is carried over.
    words = np.random.SeedSequence(training.seed, spawn_key=(segment,)).generate_state(1)
    venv = model.get_env()
    assert venv is not None
    model.set_env(venv, force_reset=True)
    model.set_random_seed(int(words[0]))
    rate = training.learning_rate(segment)
    model.lr_schedule = lambda _: rate
    model.learn(training.steps_of_segment, reset_num_timesteps=False)


def _point(
    model: BaseAlgorithm,
    figures: dict[str, float],
    begun: tuple[float, float],
    curve: list[dict[str, float]],
) -> dict[str, float]:
    """Return a point of the curve: steps, times since the start of the run [s], figures."""
    before = curve[-1] if curve else {"seconds": 0.0, "cpu_seconds": 0.0}
    wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
    return {
        "steps": model.num_timesteps,
        "seconds": round(before["seconds"] + wall, 1),
        "cpu_seconds": round(before["cpu_seconds"] + cpu, 1),
        **figures,
    }


def _words(point: dict[str, float]) -> str:
    """Return a point of the curve for a reader; the record has all digits."""
    figures = {name: value for name, value in point.items() if name not in AXES}
    seen = ", ".join(f"{name} {value:.3g}" for name, value in figures.items())
    return f"{point['steps']} steps, {point['seconds']} s, {seen}"


def _record(
    settings: Any, curve: list[dict[str, float]], final: list[dict[str, Any]], command: str
) -> dict[str, Any]:
    return {
        "command": command,
        "training": settings,
        "curve": {key: [point[key] for point in curve] for key in curve[0]},
        "final": final,
        "torch_threads": torch.get_num_threads(),
        "machine": machine(),
        "versions": versions(),
    }


def rounded(figures: dict[str, float]) -> dict[str, float]:
    """Return figures as they are written down, to four decimals."""
    return {key: round(value, 4) for key, value in figures.items()}


def _save(path: Path, settings: Any, model: BaseAlgorithm, curve: list[dict[str, float]]) -> None:
    content = {
        "training": json.dumps(settings, sort_keys=True),
        "parameters": model.get_parameters(),
        "variables": _variables(model),
        "statistics": {
            name: [torch.as_tensor(np.float64(value)) for value in (rms.mean, rms.var, rms.count)]
            for name, rms in _statistics(model).items()
        },
        "buffer": _buffer(model),
        "timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "curve": curve,
    }
    stream = io.BytesIO()
    torch.save(content, stream)
    write_atomic(path, stream.getvalue())


def _restore(path: Path, settings: Any, model: BaseAlgorithm) -> list[dict[str, float]]:
    check_file(path)
    try:
        content = torch.load(path, weights_only=True)  # tensors and plain values: no pickled code
        stored = json.loads(content["training"])
    except Exception as error:
        raise _damaged(path, error) from error
    check_same(path.parent, stored, settings)
    try:
        model.set_parameters(content["parameters"])
        for name, value in _variables(model).items():
            value.data.copy_(content["variables"][name])
        for name, rms in _statistics(model).items():
            mean, var, count = content["statistics"][name]
            rms.mean, rms.var, rms.count = mean.numpy(), var.numpy(), float(count)
        _refill(model, content["buffer"])
        model.num_timesteps = int(content["timesteps"])
        model._n_updates = int(content["updates"])
        curve: list[dict[str, float]] = [dict(point) for point in content["curve"]]
        if not all(is_finite(point[axis]) for point in curve for axis in AXES):
            raise ValueError("its learning curve holds what is no number")
    except Exception as error:
        # Torch and stable-baselines3 each raise their own for what does not fit.
        raise _damaged(path, error) from error
    return curve


def _damaged(path: Path, error: Exception) -> ValueError:
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST]
    return ValueError(f"the checkpoint {path} is damaged ({reason}); delete it")


def _variables(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return what is learned outside the networks: the weight of the entropy."""
    if isinstance(model, SAC) and model.log_ent_coef is not None:
        return {"log_ent_coef": model.log_ent_coef}
    return {}


def _statistics(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the running means and deviations of the normalisation, if there is one."""
    normalised = model.get_vec_normalize_env()
    if normalised is None:
        return {}
    features = {"features": normalised.obs_rms} if normalised.norm_obs else {}
    return {**features, "returns": normalised.ret_rms}


def _buffer(model: BaseAlgorithm) -> dict[str, Any]:
    """Return what is in the replay buffer, empty for an algorithm without one."""
    if not isinstance(model, OffPolicyAlgorithm):
        return {}
    buffer: Any = model.replay_buffer
    filled = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: torch.as_tensor(getattr(buffer, name)[:filled]) for name in _BUFFERED}
    return {**arrays, "position": int(buffer.pos), "full": bool(buffer.full)}


def _refill(model: BaseAlgorithm, stored: dict[str, Any]) -> None:
    if not isinstance(model, OffPolicyAlgorithm):
        return
    buffer: Any = model.replay_buffer
    for name in _BUFFERED:
        values = stored[name].numpy()
        getattr(buffer, name)[: len(values)] = values
    buffer.pos, buffer.full = stored["position"], stored["full"]
