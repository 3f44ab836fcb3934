"""`lagros data`: what the expert did, in the formats of other libraries."""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.extras import check_extra
from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import (
    BOUND,
    QUIET,
    Command,
    fail,
    progress_bar,
    refuse_options,
)

if TYPE_CHECKING:
    import gymnasium as gym

    from lagros_benchmarks.run.demonstrations import Demonstration, DemonstrationSettings

# Where Minari looks for its datasets.
DATASETS_PATH = "MINARI_DATASETS_PATH"

data = typer.Typer(help="Expert data for other libraries.", no_args_is_help=True)


@data.callback()
def main() -> None:
    """Expert data for other libraries."""


@data.command(cls=Command)
def export(
    minari: Annotated[bool, typer.Option("--minari", help="Write a Minari dataset.")] = False,
    task: Annotated[
        str | None,
        typer.Option(help="As for `lagros bench`, by default the first; of many agents one flies."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed; its episodes never occur in evaluation.")] = 0,
    disturbance: Annotated[
        str, typer.Option(help="Of none, uniform, sphere, constant, sinusoid, gust, switching.")
    ] = "uniform",
    bound: Annotated[float | None, BOUND] = None,
    out: Annotated[
        Path, typer.Option(file_okay=False, help=f"Folder of datasets; Minari's {DATASETS_PATH}.")
    ] = Path("runs/minari"),
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Fly the expert and write its episodes, with the record of metric and planner."""
    if not minari:
        fail("name the format to write: pass --minari")
    try:
        check_extra("--minari", "data")
    except ImportError as error:
        fail(error, status=1)
    from lagros_benchmarks.run.demonstrations import DemonstrationSettings, demonstrate
    from lagros_envs.registry import find_task, first_task

    try:
        if disturbance == "none":
            refuse_options(["--bound"], "no disturbance has a bound")
        described = find_task(task or first_task())
        settings = DemonstrationSettings(described.name, episodes, seed, disturbance, bound)
        identifier = dataset_id(described.name)
        check_free(out, identifier)
    except ValueError as error:
        fail(error)
    try:
        with progress_bar() as progress:
            flown, record = demonstrate(settings, lambda done: progress("episodes", done, episodes))
    except (ImportError, ValueError, OSError) as error:
        # An extra that is not installed, weights that are damaged.
        fail(error, status=1)
    made: list[Written] = []
    # A full disk, a dataset that came in between: what was flown is kept elsewhere.
    delivery = Delivery()
    place = out / identifier
    delivery.write(
        place,
        lambda path: made.append(
            write_minari(out if path == place else path, settings, flown, record)
        ),
    )
    for written in made:
        typer.echo(summary(written, flown))
    delivery.tell(*(note(written, flown) for written in made))
    typer.echo(f"read it with {DATASETS_PATH}={out} and minari.load_dataset('{identifier}')")


def dataset_id(task: str) -> str:
    """Return the identifier of a task's dataset, as Minari takes it."""
    return f"lagros/{task}/expert-v0"


def check_free(folder: Path, identifier: str) -> None:
    """Check that a dataset can be written, before its episodes are flown.

    Raises:
        ValueError: The folder already holds a dataset of this identifier, or takes no new file.
    """
    from lagros_envs.files import remove_folders

    place = folder / identifier
    if os.path.lexists(place):
        raise ValueError(
            f"--out: {place} is already there; name another folder with --out, or remove it"
        )
    # What is in the way of the dataset may lie further down than its folder.
    remove_folders(check_outputs({}, folders={"--out": place.parent}))


@dataclass(frozen=True)
class Written:
    """A dataset that was written.

    Attributes:
        place: Its folder.
        steps: Steps of all episodes.
        outside: Actions outside the environment's action space, of all components.
    """

    place: Path
    steps: int
    outside: int


def write_minari(
    folder: Path,
    settings: DemonstrationSettings,
    flown: Sequence[Demonstration],
    record: dict[str, Any],
) -> Written:
    """Write demonstrations as a Minari dataset in a folder of these, whole or not at all.

    Raises:
        ValueError: The folder already holds such a dataset.
        OSError: It cannot be written, or such a dataset came in between.
    """
    from minari.namespace import create_namespace, list_local_namespaces

    identifier = dataset_id(settings.task)
    check_free(folder, identifier)
    _remove_stale(folder)
    env = settings.make_env()
    try:
        outside = _outside(env, flown)
        extra = _record(flown, record, outside)
        folder.mkdir(parents=True, exist_ok=True)
        # Under a hidden name, which Minari does not list, until the last byte is there.
        with tempfile.TemporaryDirectory(prefix=f".export-{os.getpid()}-", dir=folder) as staging:
            # Minari joins a relative path to itself.
            with _datasets_path(Path(staging).resolve()):
                _create(identifier, env, settings, flown, extra)
            place = folder / identifier
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(Path(staging) / identifier, place)
    finally:
        env.close()
    namespace = identifier.rpartition("/")[0]
    with _datasets_path(folder):
        if namespace not in list_local_namespaces():
            create_namespace(namespace)
    return Written(place, sum(len(episode.rewards) for episode in flown), outside)


def _remove_stale(folder: Path) -> None:
    """Remove what exports have left behind that were killed."""
    from lagros_envs.files import is_alive

    for path in folder.glob(".export-*-*"):
        pid = path.name.split("-")[1]
        if pid.isdecimal() and not is_alive(int(pid)):
            shutil.rmtree(path, ignore_errors=True)


def summary(written: Written, flown: Sequence[Demonstration]) -> str:
    """Return the line that tells what was flown."""
    successes = sum(episode.success for episode in flown)
    failed = sum(episode.counters["failed_plans"] for episode in flown)
    return (
        f"success in {successes} of {len(flown)} episodes; plans that failed: {failed}; "
        f"actions outside the action space: {written.outside}"
    )


def note(written: Written, flown: Sequence[Demonstration]) -> str:
    """Return what is worth knowing about the files that were written."""
    size = sum(path.stat().st_size for path in written.place.rglob("*") if path.is_file()) / 1e6
    return f"{len(flown)} episodes, {written.steps} steps, {size:.1f} MB"


def _create(
    identifier: str,
    env: gym.Env[Any, Any],
    settings: DemonstrationSettings,
    flown: Sequence[Demonstration],
    extra: dict[str, Any],
) -> None:
    from minari import create_dataset_from_buffers

    from lagros_benchmarks.run.room import room_of

    package = metadata.metadata("lagros")
    with warnings.catch_warnings():
        # Neither exists: the package has no address, and its authors no common letter box.
        warnings.filterwarnings("ignore", r"`(code_permalink|author_email)` is set to None")
        dataset = create_dataset_from_buffers(
            identifier,
            [_buffer(index, episode) for index, episode in enumerate(flown)],
            env=env,
            eval_env=env.spec,
            algorithm_name=room_of(settings.described).part("demonstrations").algorithm,
            author=package["Author"],
            description=_description(settings),
            # With pyarrow, of the extra `data`; Minari's other format, HDF5, would need h5py.
            data_format="arrow",
            requirements=[f"lagros=={package['Version']}"],
        )
    dataset.storage.update_metadata(extra)
    dataset.storage.update_episode_metadata(
        [
            {
                "rewards_sum": float(episode.rewards.sum()),
                "success": episode.success,
                **episode.counters,
            }
            for episode in flown
        ]
    )


def _buffer(index: int, episode: Demonstration) -> Any:
    """Return an episode as Minari takes it: numbers over time as lists, vectors as arrays."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    return EpisodeBuffer(
        id=index,
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=episode.terminations,
        truncations=episode.truncations,
        infos={
            name: values if values.ndim > 1 else values.tolist()
            for name, values in episode.infos.items()
        },
    )


def _outside(env: gym.Env[Any, Any], flown: Sequence[Demonstration]) -> int:
    space: Any = env.action_space
    return sum(
        int(((episode.actions < space.low) | (episode.actions > space.high)).sum())
        for episode in flown
    )


def _record(flown: Sequence[Demonstration], record: dict[str, Any], outside: int) -> dict[str, Any]:
    """Return what stands in the dataset's metadata beside what Minari writes there."""
    from lagros_benchmarks.run.surroundings import own_command, versions

    return {
        "license": metadata.metadata("lagros")["License-Expression"],
        "lagros": {
            "versions": versions(),
            "command": own_command(),
            **record,
            "outcome": {
                "successes": sum(episode.success for episode in flown),
                "terminated": sum(bool(episode.terminations[-1]) for episode in flown),
                "failed_plans": sum(episode.counters["failed_plans"] for episode in flown),
                "actions_outside_space": outside,
            },
        },
    }


def _description(settings: DemonstrationSettings) -> str:
    return (
        f"Episodes of the expert in {settings.described.env_id} under the disturbance "
        f"{settings.disturbance!r} of bound {settings.disturbance_bound:g}. The expert plans once, "
        "from the start to the goal, and tracks the plan with u*. The infos hold the plan "
        "(nominal_state x_d, nominal_control u_d). Actions beyond the action space, if there are "
        "any, are counted in the metadata, and were applied as they are."
    )


@contextmanager
def _datasets_path(folder: Path) -> Iterator[None]:
    """Let Minari work in a folder; it takes the place from the environment only."""
    before = os.environ.get(DATASETS_PATH)
    os.environ[DATASETS_PATH] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[DATASETS_PATH]
        else:
            os.environ[DATASETS_PATH] = before
