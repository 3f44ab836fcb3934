"""Episodes of one body for the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lagros_benchmarks.report.page.packed import packed
from lagros_benchmarks.report.page.reels import Reel, box_of, flight, kept_instants, within
from lagros_benchmarks.report.page.worthy import Merit
from lagros_benchmarks.report.watched import outcome
from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.episodes import EpisodeRecord, run_episode
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.settings import BenchmarkSettings, Case
from lagros_benchmarks.run.single import NominalPlan, SingleExperiment, SingleRun
from lagros_envs.arrays import FloatArray
from lagros_envs.task import Task

# No state and no measure is followed farther: an integration may have diverged.
_LARGEST = 1e4
_STEP = 1e-5  # of a slope


class SingleCamera:
    """Notes the states of one body; see `reels.Camera`."""

    def __init__(self) -> None:
        self._loop: ClosedLoop | None = None
        self._states: list[FloatArray] = []
        self._pushes: list[FloatArray] = []
        self._measures: list[tuple[float, float, float]] = []

    def note(self, loop: ClosedLoop) -> None:
        """Note this control instant."""
        env, info = loop.env.unwrapped, loop.info
        self._loop, bound = loop, env.disturbance.bound
        self._states.append(env.state)
        self._pushes.append(info["disturbance"] / bound if bound > 0.0 else 0.0 * env.state)
        error = info.get("tracking_error", np.nan)
        self._measures.append((info["goal_distance"], info["tube_radius"], error))

    def reel(self, error: str | None, proved: FloatArray | None = None) -> Reel:
        """Return what was noted."""
        if self._loop is None:
            raise ValueError("nothing was noted; begin the episode first")
        env = self._loop.env.unwrapped
        task: Task = env.settings
        states = np.clip(np.array(self._states), -_LARGEST, _LARGEST)
        times = task.control_period * np.arange(len(states), dtype=np.float64)
        scene = _scene(task, env.scenario, env.nominal)
        distance, radius, off = np.clip(np.array(self._measures).T, -_LARGEST, _LARGEST)
        tube = task.tube_radius(times)
        measures = {
            "distance": distance,
            "radius": radius,
            "error": None if env.nominal is None else off,
            "tube": None if tube is None else np.asarray(tube),
            "proved": None if proved is None else proved[: len(states)],
        }
        parts = {"states": states, **_drawn(task, states)}
        reach = np.array(scene["box"])
        if parts["places"] is not None:
            parts = {name: _cut(values, reach, name) for name, values in parts.items()}
            parts["push"] = _arrows(task, states, np.array(self._pushes))
            seen = [parts[name] for name in ("places", "polygons")]
            points = [one[..., :2].reshape(-1, 2) for one in seen if one is not None]
            reach = box_of(np.concatenate(points))
        info = self._loop.info
        return Reel(
            scene,
            flight(
                outcome(info, error, task.squared_unit),
                error,
                _ending(info, error, float(times[-1])),
                [],
                times,
                parts,
                measures,
                reach,
            ),
        )


def _scene(task: Task, scenario: Any, nominal: FloatArray | None) -> dict[str, Any]:
    """Return what an episode asks for, with its plan x_d; see `Reel`."""
    scene: dict[str, Any] = {
        "discs": np.round(scenario.discs, 4).tolist(),
        "goals": [],
        "radius": None,
        "outline": None,
        "plan": None,
        "box": [-1.0, -1.0, 1.0, 1.0],
    }
    ends = np.stack([scenario.initial_state, scenario.goal])
    drawn = _drawn(task, ends)
    places, polygons = drawn["places"], drawn["polygons"]
    if places is None:
        return scene
    points = [places[..., :2].reshape(-1, 2)]
    if polygons is not None:
        points.append(polygons.reshape(-1, 2))
        scene["outline"] = np.round(polygons[1], 4).tolist()
    else:
        scene["radius"] = task.body_radius
    radius = task.success_radius(task.time_limit) if task.position else 0.0
    scene["goals"] = [[*places[1, 0, :2].tolist(), float(radius)]]
    for x, y, reach in scenario.discs:
        points.append(np.array([[x - reach, y - reach], [x + reach, y + reach]]))
    if nominal is not None:
        kept = kept_instants(len(nominal))
        planned = _drawn(task, nominal[kept])
        way = planned["places"]
        assert way is not None
        points.append(way[..., :2].reshape(-1, 2))
        scene["plan"] = {
            "times": packed(task.control_period * kept),
            **{name: packed(one) for name, one in planned.items() if one is not None},
            # How far a ball of radius 1 around x_d reaches across and up, to first order.
            "spread": packed(np.linalg.norm(_slopes(task, nominal[kept]), axis=-1)),
        }
    scene["box"] = np.round(box_of(np.concatenate(points)), 4).tolist()
    return scene


def _drawn(task: Task, states: FloatArray) -> dict[str, FloatArray | None]:
    """Return places (instants, 1, 2) of a body and its polygons (instants, corners, 2).

    A body that is a disc has its heading beside its place.
    """
    places = _places(task, states)
    if not places.size:
        return {"places": None, "polygons": None}
    outlines = [task.outline(state) for state in states]
    polygons = np.array([np.concatenate(one) for one in outlines]) if outlines[0] else None
    if polygons is None:
        moves = np.diff(places, axis=0, append=2.0 * places[-1:] - places[-2:-1])
        places = np.column_stack([places, np.arctan2(moves[:, 1], moves[:, 0])])
    return {"places": places[:, None], "polygons": polygons}


def _places(task: Task, states: FloatArray) -> FloatArray:
    return np.array([task.place(state) for state in states])


def _slopes(task: Task, states: FloatArray) -> FloatArray:
    """Return the slopes of the body's place by its state, (instants, 2, n)."""
    shifts = _STEP * np.eye(states.shape[1])
    columns = [
        (_places(task, states + shift) - _places(task, states - shift)) / (2.0 * _STEP)
        for shift in shifts
    ]
    return np.stack(columns, axis=-1)


def _cut(values: FloatArray | None, box: FloatArray, name: str) -> FloatArray | None:
    """Return what is drawn no farther from the scene than anybody looks."""
    if values is None or name == "states":
        return values
    near = values.copy()
    near[..., :2] = within(values[..., :2], box)
    return near


def _arrows(task: Task, states: FloatArray, pushes: FloatArray) -> FloatArray:
    """Return how d / d_bar moves the place, and its rate where d has one, (instants, 1, 2 or 4)."""
    slopes = _slopes(task, states)
    arrows = [np.einsum("kin,kn->ki", slopes, pushes)]
    rates = list(task.rates)
    others = [entry for entry in range(states.shape[1]) if entry not in rates]
    if len(rates) == len(task.position):
        others = list(task.position)
    if len(rates) == len(others):
        arrows.append(np.einsum("kin,kn->ki", slopes[..., others], pushes[:, rates]))
    return np.concatenate(arrows, axis=-1)[:, None]


def _ending(info: dict[str, Any], error: str | None, time: float) -> dict[str, Any] | None:
    """Return what ended an episode before its time, or that it never came to the goal."""
    if error is not None:
        label = "the policy raised"
    elif info["fallen"]:
        label = "fallen"
    elif info.get("collided"):
        label = "collided"
    elif not info["success"]:
        label = "not at the goal in time"
    else:
        return None
    return {"time": time, "label": label, "body": 0}


class SingleReels:
    """Flies episodes of a benchmark of one body again, for the page."""

    @staticmethod
    def merit(record: EpisodeRecord) -> Merit:
        """Return how an episode went: the farther from its plan, the worse."""
        return Merit(not record.success, record.max_tracking_error or record.effort)

    @staticmethod
    def units(run: SingleRun) -> Sequence[NominalPlan]:
        """Return what every episode is begun with."""
        return run.plans

    @staticmethod
    def fly(
        settings: BenchmarkSettings,
        toolbox: Toolbox,
        case: Case,
        units: Sequence[NominalPlan],
        records: Sequence[EpisodeRecord],
    ) -> list[Reel | None]:
        """Fly episodes again; None where not even the reset comes to an end."""
        task: Any = settings.description
        experiment = SingleExperiment(settings, toolbox, task, {})
        env = experiment.environment(case.condition)
        policy = experiment.policy(case.policy, env)
        return [
            _again(env, policy, plan, record) for plan, record in zip(units, records, strict=True)
        ]


def _again(env: Any, policy: Any, plan: NominalPlan, record: EpisodeRecord) -> Reel | None:
    camera = SingleCamera()
    again = run_episode(
        env,
        policy,
        plan.seed,
        plan.states,
        label=record.policy,
        initial_error=plan.initial_error,
        watch=camera.note,
    )
    try:
        reel = camera.reel(again.error, record.error_bounds)
    except ValueError:
        return None
    names = ("success", "strict_success", "fallen", "collided", "error", "success_time")
    same = all(getattr(again, name) == getattr(record, name) for name in names)
    reel.flight["as_recorded"] = same and bool(np.isclose(again.effort, record.effort, 1e-3))
    return reel
