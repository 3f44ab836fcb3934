"""`lagros watch`: one episode as it moves, in a window or as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs, policy_files
from lagros_benchmarks.commands.terminal import (
    BOUND,
    fail,
    file_option,
    find_users_modules,
    refuse_options,
    task_in_preset,
)


def watch(
    task: Annotated[str, typer.Argument(help="As for `lagros bench`.")],
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="A policy of the task, a stable-baselines3 .zip, or module:Class."
        ),
    ] = "lagros",
    agents: Annotated[
        int | None, typer.Option(help="Number of agents; the preset's own if not given.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="Kind of worlds of agents, or form of a body; {presets}.")
    ] = None,
    disturbance: Annotated[
        str, typer.Option(help="Of none, uniform, sphere, constant, sinusoid, gust, switching.")
    ] = "uniform",
    bound: Annotated[float | None, BOUND] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episode.")] = 0,
    scenario: Annotated[
        Path | None, file_option("A scenario as JSON, in place of the drawn one.")
    ] = None,
    safety_filter: Annotated[
        bool, typer.Option("--safety-filter", help="Put the safety filter on the policy.")
    ] = False,
    video: Annotated[
        Path | None, file_option("Write a .gif or .mp4 instead of opening a window.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(help="How much faster than real time it plays; the task's own if not given."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="End after so many seconds of the episode.")
    ] = None,
) -> None:
    """Watch one episode: bodies, what they sense, tubes, goals, collisions.

    Exit status 3: the policy raised, which ended the episode as a failure.
    """
    from lagros_benchmarks.report.playback import Playback, WatchSettings
    from lagros_benchmarks.run.flying import RAISED
    from lagros_benchmarks.run.library import SetupError
    from lagros_envs.files import write_atomic
    from lagros_envs.registry import find_task

    find_users_modules([policy])
    try:
        if disturbance == "none":
            refuse_options(["--bound"], "no disturbance has a bound")
        task, preset = task_in_preset(task, preset)
        settings = WatchSettings(
            task=find_task(task).name,
            policy=policy,
            agents=agents,
            preset=preset,
            disturbance=disturbance,
            bound=bound,
            seed=seed,
            scenario=scenario,
            safety_filter=safety_filter,
            video=video,
            speed=speed,
            seconds=seconds,
        )
        playback = Playback(settings)
        check_outputs({"--video": video}, {"--scenario": scenario, **policy_files([policy])})
    except (ValueError, OSError) as error:
        fail(error)
    except (ImportError, SetupError) as error:
        fail(error, status=1)
    try:
        film = playback.play()
    except KeyboardInterrupt:
        if video is not None:
            raise
        raise typer.Exit from None
    except (ImportError, OSError, RuntimeError) as error:
        fail(error, status=1)
    finally:
        playback.close()
    delivery = Delivery()
    content = film or b""
    delivery.write(video, lambda path: write_atomic(path, content))
    for line in playback.summary():
        typer.echo(line)
    delivery.tell(f"{playback.frames} frames, {len(content) / 1e6:.2g} MB")
    if playback.error is not None:
        raise typer.Exit(RAISED)
