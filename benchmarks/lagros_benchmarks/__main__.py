"""The command `lagros`, also as `python -m lagros_benchmarks`."""

from __future__ import annotations

import sys

from lagros_benchmarks.commands.extras import install_hint
from lagros_benchmarks.run.process import end_with_threads


def main() -> None:
    """Run the command line; where it lacks a package of an extra, say which and end with 1."""
    try:
        from lagros_benchmarks.commands.cli import app

        app(prog_name="lagros")
    except SystemExit as ending:
        end_with_threads(ending.code if isinstance(ending.code, int) else 1)
        raise
    except ModuleNotFoundError as error:
        hint = install_hint(error)
        if not hint:
            raise
        sys.exit(f"lagros: {error}{hint}")
    except KeyboardInterrupt:
        # Before a command has begun; what one says is in `terminal.Commands`.
        sys.exit(130)


if __name__ == "__main__":
    main()
