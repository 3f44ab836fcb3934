"""Models of stable-baselines3 as policies, loaded only where a user names one."""

from __future__ import annotations

import importlib
import io
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.reading import check_file, parse_json
from lagros_envs.registry import task_named, task_names
from lagros_envs.task import Described, Task
from lagros_policies.naming import ALGORITHMS
from lagros_policies.observed import as_numbers
from lagros_policies.policy import BasePolicy
from lagros_policies.room import part_of

# What a file may expand to [bytes] and how many entries it may have: a policy of a hundred layers
# has less.
MOST_EXPANDED = 1 << 28
MOST_ENTRIES = 100
_LIBRARY = "stable_baselines3.common"


class Spaces(NamedTuple):
    """What a policy of one agent of a task observes and answers.

    Attributes:
        observation: Shape of an observation.
        action: Shape of an action.
        low: Least entry of an action.
        where: Whose they are, for a message.
        high: Largest entry.
    """

    observation: tuple[int, ...]
    action: tuple[int, ...]
    low: Any
    where: str
    high: Any = 1.0


def single_spaces(task: Task) -> Spaces:
    """Return what a policy of a task of one body observes and answers."""
    return Spaces((task.layout.size,), (task.system.control_dim,), -1.0, f"{task.env_id} has")


class Normalisation(NamedTuple):
    """How `VecNormalize` has shown observations to a model: clip((o - mean) / deviation, +-clip).

    Attributes:
        mean: Shape (o,).
        deviation: Likewise.
        clip: Largest value.
    """

    mean: FloatArray
    deviation: FloatArray
    clip: float

    def seen(self, rows: Float32Array) -> Float32Array:
        """Return observations (..., o) as the model sees them."""
        scaled = np.clip((rows - self.mean) / self.deviation, -self.clip, self.clip)
        return scaled.astype(np.float32)


def normalisation_of(wrapper: Any) -> Normalisation | None:
    """Return how a `VecNormalize` shows observations; None without one, or where it shows them all.

    Raises:
        ValueError: It normalises observations of several parts, which are none of this package.
    """
    if wrapper is None or not wrapper.norm_obs:
        return None
    statistics = wrapper.obs_rms
    if not hasattr(statistics, "mean"):
        raise ValueError("VecNormalize of observations in several parts: those here are flat")
    deviation = np.sqrt(statistics.var + wrapper.epsilon)
    return Normalisation(np.array(statistics.mean), deviation, float(wrapper.clip_obs))


def limits(space: Any) -> tuple[Any, Any]:
    """Return the least and the largest entry of an action of a space of Gymnasium's."""
    if hasattr(space, "low"):
        return space.low, space.high
    # Of those that count: from `start`, or from 0, so many.
    count = np.asarray(getattr(space, "nvec", getattr(space, "n", 0)))
    start = getattr(space, "start", 0)
    binary = type(space).__name__ == "MultiBinary"
    return start, (1 if binary else start + count - 1)


class StableBaselines3Policy(BasePolicy):
    """A stable-baselines3 model with the interface and the checks of this package.

    Args:
        model: The model, of observations and actions of the task; where there are many agents, of
            one of them, and all share it.
        name: Name in tables.
        settings: The task; None for the paper's.
        normalisation: How observations were shown to it; None for as they are.
        told: What else the policies of the task are built with, such as a preset.

    Raises:
        ValueError: The model was trained on other spaces or within other bounds of the action, or
            there is no such preset.
    """

    def __init__(
        self,
        model: Any,
        name: str,
        settings: Described | None = None,
        normalisation: Normalisation | None = None,
        **told: Any,
    ) -> None:
        task = _usual(told) if settings is None else settings
        wanted: Spaces = part_of(task, "SPACES", "lagros_policies.sb3_model:single_spaces")(
            task, **told
        )
        spaces = model.observation_space.shape, model.action_space.shape
        if spaces != (wanted.observation, wanted.action):
            raise ValueError(
                f"{name} was trained on observations of shape {spaces[0]} and actions of shape "
                f"{spaces[1]}; {wanted.where} {wanted.observation} and {wanted.action}. A model "
                "that was trained behind wrappers cannot be used without them"
            )
        low, high = limits(model.action_space)
        if not (np.all(low == wanted.low) and np.all(high == wanted.high)):
            raise ValueError(
                f"{name} was trained on actions from {np.min(low):g} to {np.max(high):g}; those of "
                f"the task are from {np.min(wanted.low):g} to {np.max(wanted.high):g}. A model "
                "that was trained behind wrappers cannot be used without them"
            )
        if normalisation is not None and normalisation.mean.shape != wanted.observation:
            raise ValueError(
                f"{name}: observations are normalised by means of shape "
                f"{normalisation.mean.shape}; {wanted.where} {wanted.observation}"
            )
        self.name = name
        self.model = model
        self.normalisation = normalisation

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return the model's action and state; see `Policy.predict`.

        Raises:
            ValueError: The observation is not one of the task, or not finite.
        """
        rows = as_numbers(observation, np.float32)
        if not np.isfinite(rows).all():
            raise ValueError("the observation is not finite")
        if self.normalisation is not None:
            rows = self.normalisation.seen(rows)
        action, state = self.model.predict(rows, state, episode_start, deterministic)
        return np.asarray(action, np.float32), state


def _usual(told: Mapping[str, Any]) -> Described:
    """Return the first task whose policies are told such things."""
    tasks = [task_named(name) for name in task_names()]
    return next(task for task in tasks if bool(task.presets) == bool(told))


def packed(given: Any, name: str) -> Any:
    """Return a model of stable-baselines3 as a function that makes a policy of a task.

    It is a copy of what the model is now, without its environment, and travels to other processes;
    observations are shown to it as the `VecNormalize` of that environment does. Anything else is
    returned as it is.

    Args:
        given: The model, or something else.
        name: Name of the policy in tables.

    Raises:
        ValueError: As `normalisation_of`.
    """
    kinds = [kind for kind in type(given).__mro__ if kind.__module__ == f"{_LIBRARY}.base_class"]
    if not kinds:
        return given
    content = io.BytesIO()
    given.save(content)
    normalisation = normalisation_of(given.get_vec_normalize_env())
    return partial(_unpacked, type(given), content.getvalue(), name, normalisation)


def _unpacked(
    kind: Any,
    content: bytes,
    name: str,
    normalisation: Normalisation | None,
    settings: Described,
    **told: Any,
) -> StableBaselines3Policy:
    model = kind.load(io.BytesIO(content), device="cpu")
    return StableBaselines3Policy(model, name, settings, normalisation, **told)


def load_stable_baselines3(
    path: Path | str,
    algorithm: str | None = None,
    settings: Described | None = None,
    vecnormalize: Path | str | None = None,
    **told: Any,
) -> StableBaselines3Policy:
    """Load a model saved by stable-baselines3's `model.save(path)`.

    Such a zip holds pickles, which is to say code: loading it runs whatever its author put there.
    This package loads one only where the caller names it, ships none, and unpickles nothing in
    order to find out the algorithm. Load only files that you trust.

    Args:
        path: The zip file.
        algorithm: One of `ALGORITHMS`, in any case; None to detect it.
        settings: As for `StableBaselines3Policy`.
        vecnormalize: What `VecNormalize.save` has written, where the model was trained behind one.
            It is a pickle: code, which runs. None looks for no such file.
        told: As `settings`.

    Returns:
        The policy, on the CPU, named after the file.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: The extra `rl` is not installed.
        ValueError: The file is no such model, would expand to more than `MOST_EXPANDED`, its
            algorithm is unknown or cannot be detected, or its spaces are not those of the task.
    """
    check_archive(path)
    path = Path(path)
    chosen = detect_algorithm(path) if algorithm is None else algorithm.upper()
    if chosen not in ALGORITHMS:
        raise ValueError(f"algorithm {algorithm!r} is not known; use one of {_known()}")
    try:
        library = importlib.import_module("stable_baselines3")
    except ImportError as error:
        raise ImportError(
            f"{path} needs stable-baselines3: pip install 'lagros[rl]' (or 'lagros[all]')"
        ) from error
    try:
        model = getattr(library, chosen).load(path, device="cpu")
    except Exception as error:  # a pickle can raise anything
        raise ValueError(
            f"{path} could not be loaded as a {chosen} model of stable-baselines3 "
            f"{library.__version__} ({_line(error)})"
        ) from error
    normalisation = None if vecnormalize is None else _normalisation_in(vecnormalize, model)
    return StableBaselines3Policy(model, path.stem, settings, normalisation, **told)


def _normalisation_in(path: Path | str, model: Any) -> Normalisation | None:
    """Return the normalisation of a file, which is unpickled: its author's code runs."""
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    name = check_file(path, MOST_EXPANDED)
    spaces = gym.Env[Any, Any]()
    spaces.observation_space, spaces.action_space = model.observation_space, model.action_space
    try:
        wrapper = VecNormalize.load(str(path), DummyVecEnv([lambda: spaces]))
        return normalisation_of(wrapper)
    except Exception as error:  # a pickle can raise anything
        raise ValueError(
            f"{name} is no VecNormalize of this model's observations ({_line(error)})"
        ) from error


def detect_algorithm(path: Path | str) -> str:
    """Tell the algorithm of a stable-baselines3 zip from its JSON part, unpickling nothing.

    The zip does not name its class. Its entry `data` is a JSON object of the model's attributes,
    and these differ: only PPO has a `clip_range`, only SAC a `target_entropy`, only TD3 and DDPG a
    `target_policy_noise`. A2C shares its policy class with PPO alone. DDPG is the TD3 without
    delay and without clipped noise.

    Returns:
        One of `ALGORITHMS`.

    Raises:
        ValueError: The file is no stable-baselines3 zip, or of another algorithm.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            text = archive.read("data")
    except Exception as error:  # zipfile, zlib and the system each raise their own
        raise ValueError(
            f"{path} is not a model saved by stable-baselines3: it has no readable entry 'data' "
            f"({_line(error)})"
        ) from error
    data = parse_json(text, f"{path}: its entry 'data'", all_finite=False)
    if not isinstance(data, dict):
        raise _unclear(path)
    kind = data.get("policy_class")
    module = kind.get("__module__", "") if isinstance(kind, dict) else ""
    if not str(module).startswith("stable_baselines3."):
        raise _unclear(path)  # of sb3_contrib, or a policy class of the user's own
    if "target_policy_noise" in data:
        plain = data.get("policy_delay") == 1 and data.get("target_noise_clip") == 0.0
        return "DDPG" if plain else "TD3"
    if "target_entropy" in data:
        return "SAC"
    if "clip_range" in data and "n_epochs" in data:
        return "PPO"
    if "gae_lambda" in data and "normalize_advantage" in data:
        return "A2C"
    raise _unclear(path)


def check_archive(path: Path | str) -> None:
    """Check, before anything in it is expanded, that a zip is no larger than a model.

    Args:
        path: The zip file; the weights in it are zips of their own.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no zip, has entries that no model has, or would expand to too much.
    """
    name = check_file(path, MOST_EXPANDED)
    try:
        with zipfile.ZipFile(path) as archive:
            expanded = _expanded(archive)
            for entry in archive.namelist():
                if entry.endswith(".pth") and expanded <= MOST_EXPANDED:
                    weights = io.BytesIO(archive.read(entry))
                    if zipfile.is_zipfile(weights):
                        with zipfile.ZipFile(weights) as inner:
                            expanded += _expanded(inner)
    except Exception as error:  # zipfile, zlib and the system each raise their own
        raise ValueError(
            f"{name} is not a model saved by stable-baselines3 ({_line(error)})"
        ) from error
    if expanded > MOST_EXPANDED:
        raise ValueError(
            f"{name} would expand to {expanded / 1e6:.0f} MB, more than the "
            f"{MOST_EXPANDED / 1e6:.0f} MB that a model may have; if you trust it, load it with "
            "stable-baselines3 and pass it to StableBaselines3Policy"
        )


def _expanded(archive: zipfile.ZipFile) -> int:
    """Return what the entries say they expand to; zipfile reads no more of them.

    Raises:
        ValueError: There are too many, or one has no name of a plain file.
    """
    entries = archive.infolist()
    if len(entries) > MOST_ENTRIES:
        raise ValueError(f"it has {len(entries)} entries; a model has at most {MOST_ENTRIES}")
    if len({entry.filename for entry in entries}) < len(entries):
        raise ValueError("it names an entry twice")
    for entry in entries:
        place = PurePosixPath(entry.filename.replace("\\", "/"))
        if place.is_absolute() or ".." in place.parts:
            raise ValueError(f"its entry {entry.filename!r} lies outside of it")
    return sum(entry.file_size for entry in entries)


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _unclear(path: Path | str) -> ValueError:
    return ValueError(
        f"{path} does not tell which algorithm it is of; say so with a prefix, e.g. ppo:{path} "
        f"(one of {_known()})"
    )


def _known() -> str:
    return ", ".join(name.lower() for name in ALGORITHMS)
