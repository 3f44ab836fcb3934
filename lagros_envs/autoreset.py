"""How a vector environment starts the next episode of a world that has ended."""

from __future__ import annotations

from gymnasium.vector import AutoresetMode

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
    if mode not in MODES:
        raise ValueError(f"autoreset_mode={mode!r} must be one of {', '.join(MODES)}")
    return MODES[mode]
