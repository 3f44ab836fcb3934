"""What vector environments share: seeds, masks, and how a world whose episode ended starts anew."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.checks import check_name, shown
from lagros_envs.conventions import (
    Conforming,
    End,
    LimitedSettings,
    check_started,
    check_step_limit,
    plain_seed,
    warned_after,
)
from lagros_envs.disturbances import Disturbance
from lagros_envs.options import known_options
from lagros_envs.seeding import SharedStreams

MODES = {
    "next_step": AutoresetMode.NEXT_STEP,
    "same_step": AutoresetMode.SAME_STEP,
    "disabled": AutoresetMode.DISABLED,
}


def autoreset_mode_named(mode: str | AutoresetMode) -> AutoresetMode:
    """Return an autoreset mode by its name; a mode stays as it is.

    Raises:
        ValueError: The name is unknown.
    """
    if isinstance(mode, AutoresetMode):
        return mode
    check_name("autoreset_mode", mode, MODES)
    return MODES[mode]


def nominal_after(
    kept: FloatArray | None, starting: BoolArray, given: FloatArray | None
) -> FloatArray | None:
    """Return the nominal trajectories of all worlds after some have started an episode.

    Args:
        kept: Those of the episodes so far, the worlds first; None if no world has one.
        starting: Which worlds have started.
        given: What the new episodes are to follow, for all worlds; None for nothing.

    Returns:
        A new array, nan for a world without a nominal, or None if there is nothing to keep or give.
    """
    if given is None and kept is None:
        return None
    new = np.full_like(cast(FloatArray, kept), np.nan) if given is None else given
    old = np.full_like(new, np.nan) if kept is None else kept
    return np.where(starting.reshape(-1, *[1] * (new.ndim - 1)), new, old)


class RestartingVectorEnv(Conforming, gym.vector.VectorEnv[Float32Array, Float32Array, Any]):
    """Worlds side by side, each of which starts a new episode when its own has ended.

    A world has one row or more in what is observed and done. A subclass moves the worlds and says
    how one starts; `reset` and the autoreset modes are here.

    `reset(seed=...)` takes a list with one seed per world, each of which starts the episode that
    the single environment starts, or one integer for the list that begins with it: seed, seed + 1,
    ..., as in Gymnasium's `SyncVectorEnv`. Episodes that begin without a seed, those of autoreset
    among them, draw from what all worlds share: the same seed gives the same again.
    `reset(options=...)` takes `reset_mask` (worlds,), the worlds to start; what the options say of
    the others is not looked at. A reset that is refused leaves every world as it was.

    Args:
        num_envs: Number of rows.
        num_worlds: Number of worlds.
        single_observation_space: Of one row.
        single_action_space: Of one row.
        disturbance: The disturbance.
        settings: The task.
        max_episode_steps: Control steps after which an episode is truncated, at most those of the
            task; None for those. `gym.make_vec` passes the number that the id is registered with.
        autoreset_mode: "next_step" (Gymnasium's default), "same_step" (the last observation and
            info of an episode come in `info["final_obs"]` and `info["final_info"]`) or "disabled".
        render_mode: Must be None.
        drawn_by: What a user who wants to see a world makes instead.

    Raises:
        ValueError: The mode is unknown, the limit contradicts the task, or a render mode was asked
            for.
    """

    # What `reset(options=...)` may hold.
    option_names: tuple[str, ...] = ("reset_mask",)
    metadata = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        num_worlds: int,
        single_observation_space: spaces.Space[Any],
        single_action_space: spaces.Space[Any],
        disturbance: Disturbance,
        settings: LimitedSettings,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
        render_mode: str | None,
        drawn_by: str,
    ) -> None:
        """Set up the spaces; see the class for the arguments."""
        if render_mode is not None:
            raise ValueError(
                f"render_mode={render_mode!r}: the vector environment does not draw; use {drawn_by}"
            )
        check_step_limit(max_episode_steps, settings, self._usual_steps())
        self._step_limit = min(settings.steps, max_episode_steps or settings.steps)
        self.num_envs, self.num_worlds = num_envs, num_worlds
        self.single_observation_space = single_observation_space
        self.single_action_space = single_action_space
        self.observation_space = batch_space(single_observation_space, num_envs)
        self.action_space = batch_space(single_action_space, num_envs)
        self.disturbance = disturbance
        self.autoreset_mode = autoreset_mode_named(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = None
        # Worlds whose episode ended and that start anew on the next call of step.
        self._pending = np.zeros(num_worlds, bool)
        self._started = False
        # Of the episodes of all worlds, where nothing starts them anew.
        self._end = End.NOT_YET
        self._streams: SharedStreams | None = None

    @property
    def step_limit(self) -> int:
        """Control steps after which an episode is truncated."""
        return self._step_limit

    @abstractmethod
    def _start(self, worlds: IntArray, seeds: Sequence[int] | None, given: dict[str, Any]) -> None:
        """Begin an episode in these worlds with what `_checked` returned.

        Each has a seed of its own, or all draw from `_shared` or `np_random`.
        """

    @abstractmethod
    def _checked(self, mask: BoolArray, options: dict[str, Any]) -> dict[str, Any]:
        """Check the options of a reset for the masked worlds, and return what to start from."""

    @abstractmethod
    def _set_nominal(self, mask: BoolArray, given: dict[str, Any]) -> None:
        """Take the nominal trajectories of the masked worlds from what `_checked` returned."""

    @abstractmethod
    def _forget_nominal(self, mask: BoolArray) -> None:
        """The masked worlds start an episode that nobody has planned."""

    @abstractmethod
    def _observation(self) -> Float32Array:
        """Return the observation of every row."""

    @abstractmethod
    def _info(self) -> dict[str, Any]:
        """Return the info, every entry an array of its own with a leading axis of rows."""

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`.

        Args:
            seed: One integer, or one per world; a world whose own is None starts without.
            options: See the class.

        Returns:
            Observations, one per row, and the info, whose entries have a leading axis of rows.

        Raises:
            ValueError: A seed is none, or an option is unknown, or one of the two has a wrong
                length, shape or value.
        """
        options = known_options(options, self.option_names)
        seeds = self._seeds(seed)
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_worlds, bool)))
        if mask.shape != (self.num_worlds,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options['reset_mask'] must be {self.num_worlds} booleans, one per world"
            )
        if not self._started and not mask.all():
            raise ValueError("the first reset must start every world; leave out reset_mask")
        given = self._checked(mask, options)
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
        elif known := [value for value in seeds or () if value is not None]:
            # The episodes that autoreset starts are as reproducible as the first ones.
            self.np_random = np.random.default_rng(known)
        self._begin(mask, seeds, given)
        self._set_nominal(mask, given)
        self._started, self._end = True, End.NOT_YET
        return self._observation(), self._info()

    def _need_start(self) -> None:
        check_started(self._started, "step()")
        if self._end is not End.NOT_YET:
            self._end = warned_after(self._end)

    @property
    def _shared(self) -> SharedStreams:
        """What episodes without a seed draw from; renewed with `np_random`."""
        if self._streams is None or self._streams.source is not self.np_random:
            self._streams = SharedStreams(self.np_random)
        return self._streams

    def _restarting(self) -> BoolArray | None:
        """Return which worlds are to start anew on this step, None for none.

        They are moved with the others, since that is quicker than to leave them out, and started
        by `_restart` thereafter.
        """
        if not np.count_nonzero(self._pending):
            return None
        self._refuse_worst()
        return self._pending

    def _restart(self, worlds: BoolArray, *zeroed: NDArray[Any]) -> None:
        """Start what `_restarting` gave; this step has brought these worlds nothing.

        Args:
            worlds: Which worlds.
            zeroed: Rewards and ends of the step, the worlds first; false there from now on.
        """
        some = np.flatnonzero(worlds)
        for array in zeroed:
            array[some] = 0
        self._begin_unasked(worlds)

    def _after_step(self, ended: BoolArray) -> tuple[Float32Array, dict[str, Any]]:
        """Return observation and info of a step, after the restarts that the mode asks for.

        Args:
            ended: Which worlds' episodes ended on this step.
        """
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._pending = ended
        elif self.autoreset_mode is AutoresetMode.DISABLED:
            self._note_end(ended)
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and np.count_nonzero(ended):
            final_observation, final_info = self._observation(), self._info()
            self._begin_unasked(ended)
            rows = np.repeat(ended, self.num_envs // self.num_worlds)
            info = self._info()
            info["final_obs"], info["_final_obs"] = final_observation, rows
            info["final_info"], info["_final_info"] = final_info, rows
            return self._observation(), info
        return self._observation(), self._info()

    def _note_end(self, ended: BoolArray) -> None:
        # Where some worlds go on the others are stepped along with them; nobody has to look at
        # what becomes of those. Where none goes on, a further step is a mistake.
        if self._end is End.NOT_YET and np.count_nonzero(ended) == ended.size:
            self._end = End.REACHED

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None] | None:
        given: Any = seed
        # Bytes are a sequence of integers, but nobody's seeds.
        texts, lists = (str, bytes, bytearray), (Sequence, np.ndarray)
        if not isinstance(given, lists) or isinstance(given, texts) or np.ndim(given) == 0:
            first = plain_seed(given)
            # Gymnasium's convention. The runs of this project give lists, from
            # `seeding.episode_seeds`: neighbouring seeds would share episodes.
            return None if first is None else list(range(first, first + self.num_worlds))
        seeds = list(given)
        if len(seeds) != self.num_worlds:
            raise ValueError(
                f"seed={shown(seed)} must be {self.num_worlds} non-negative integers, one per world"
            )
        return [plain_seed(value) for value in seeds]

    def _refuse_worst(self) -> None:
        if self.disturbance.kind == "worst":
            raise ValueError(
                'disturbance="worst" needs nominal trajectories for every episode, and an '
                'autoreset starts one without: use autoreset_mode="disabled" and reset with '
                'options={"nominal": ..., "reset_mask": ...}'
            )

    def _begin_unasked(self, mask: BoolArray) -> None:
        """Start the episodes of an autoreset, for which nobody has planned a nominal."""
        self._refuse_worst()
        self._forget_nominal(mask)
        self._begin(mask, None, {})

    def _begin(
        self, mask: BoolArray, seeds: list[int | None] | None, given: dict[str, Any]
    ) -> None:
        """Start the masked worlds, from the seeds of all or from the shared generators."""
        worlds = np.flatnonzero(mask)
        if not worlds.size:
            return
        if seeds is None:
            self._start(worlds, None, given)
        else:
            seeded = np.array([seeds[world] is not None for world in worlds], bool)
            chosen = [cast(int, seeds[world]) for world in worlds[seeded]]
            for some, theirs in ((worlds[seeded], chosen), (worlds[~seeded], None)):
                if some.size:
                    self._start(some, theirs, given)
        self._pending = self._pending & ~mask
