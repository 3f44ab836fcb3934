"""`lagros watch`: one episode as it moves, in a window or as a video."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs, policy_files
from lagros_benchmarks.commands.terminal import (
    BOUND,
    QUIET,
    fail,
    file_option,
    find_users_modules,
    progress_bar,
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
    html: Annotated[
        Path | None, file_option("Write a page for a browser that plays it, with its curves.")
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser", help="Open that page; without --html, a temporary one.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(help="How much faster than real time it plays; the task's own if not given."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="End after so many seconds of the episode.")
    ] = None,
    quiet: Annotated[bool, QUIET] = False,
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
            page=browser or html is not None,
            speed=speed,
            seconds=seconds,
        )
        playback = Playback(settings)
        inputs = {"--scenario": scenario, **policy_files([policy])}
        check_outputs({"--video": video, "--html": html}, inputs)
    except (ValueError, OSError) as error:
        fail(error)
    except (ImportError, SetupError) as error:
        fail(error, status=1)
    try:
        if settings.page or video is None:
            film = playback.page().encode() if settings.page else playback.play()
        else:
            with progress_bar() as tell:
                film = playback.play(tell)
    except KeyboardInterrupt:
        if video is not None or settings.page:
            raise
        raise typer.Exit from None
    except (ImportError, OSError, RuntimeError) as error:
        fail(error, status=1)
    finally:
        playback.close()
    delivery = Delivery()
    content = film or b""
    page = html or (_temporary() if browser else None)
    delivery.write(page or video, lambda path: write_atomic(path, content))
    for line in playback.summary():
        typer.echo(line)
    frames = "" if settings.page else f"{playback.frames} frames, "
    delivery.tell(f"{frames}{len(content) / 1e6:.2g} MB")
    if browser and page is not None:
        _open(page)
    if playback.error is not None:
        raise typer.Exit(RAISED)


def _temporary() -> Path:
    """Return where a page may lie that nobody has named; the browser reads it when it pleases."""
    return Path(tempfile.mkdtemp(prefix="lagros-")) / "episode.html"


def _open(page: Path) -> None:
    import webbrowser

    if not webbrowser.open(page.resolve().as_uri()):
        typer.echo(f"lagros: no browser can be opened here; open {page} yourself", err=True)
