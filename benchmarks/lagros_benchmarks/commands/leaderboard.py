"""`lagros leaderboard`: submitted results, checked, and in order."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import (
    QUIET,
    fail,
    file_option,
    find_users_modules,
    progress_bar,
    refuse_options,
)

_MOST_EPISODES = 200


def leaderboard(
    files: Annotated[
        list[Path],
        typer.Argument(help="Submissions, WHEN_WHO.json each, as `lagros bench --json` writes."),
    ],
    rerun: Annotated[
        int, typer.Option(metavar="N", help="Fly the first N episodes of each row again.")
    ] = 0,
    trust: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="Policies of the submissions that are code of somebody's, which --rerun may run.",
        ),
    ] = None,
    markdown: Annotated[Path | None, file_option("The tables, as Markdown.")] = None,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Check submitted results and put them in order; a submission is data, of which nothing runs.

    Exit status 1: one is not as it should be. It is named with what is wrong, and left out.
    """
    from lagros_benchmarks.report.leaderboard import fly_again, read_submission, table
    from lagros_benchmarks.run.library import SetupError
    from lagros_envs.checks import check_whole
    from lagros_envs.reading import named
    from lagros_policies.naming import listed_names

    trusted = () if trust is None else listed_names(trust)
    try:
        check_whole("rerun", rerun, 0, _MOST_EPISODES)
        if not rerun:
            refuse_options(["--trust"], "nothing is flown without --rerun")
        for path in files:
            if not path.is_file():
                raise ValueError(f"files: there is no file {named(path)}")
        inputs = {f"submission {path}": path for path in files}
        check_outputs({"--markdown": markdown}, inputs)
    except ValueError as error:
        fail(error)
    find_users_modules(trusted)
    kept, refused = [], 0
    for path in files:
        try:
            submission = read_submission(path)
            note = f"{len(submission.rows)} rows"
            if rerun:
                with progress_bar() as tell:
                    note += f"; {fly_again(submission, rerun, trusted, tell)}"
        except (ValueError, OSError, ImportError, SetupError) as error:
            typer.echo(f"refused: {error}", err=True)
            refused += 1
        else:
            typer.echo(f"{path.name}: as it should be, {note}")
            kept.append(submission)
    text = table(kept)
    delivery = Delivery()
    delivery.write_text(markdown, lambda: text)
    if markdown is None and text:
        typer.echo(f"\n{text}")
    delivery.tell()
    if refused:
        raise typer.Exit(1)
