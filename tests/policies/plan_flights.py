"""Flights of a linear law along a plan, and disturbances that try to drive it far."""

import numpy as np

from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.dynamics.system import components
from lagros_envs.numbers import dual, functions


def in_ball(pushes, bound):
    """Return pushes with a norm of exactly the bound; zero stays zero."""
    size = np.linalg.norm(pushes, axis=-1, keepdims=True)
    return bound * pushes / np.where(size > 0.0, size, 1.0) * (1.0 - 1e-12)


def flown(system, period, plan, gains, pushes, limits=(-np.inf, np.inf)):
    """Return the errors (f, N + 1, n) of flights under pushes (f, N, n), as they are simulated.

    The law sees a state in single precision, and its control arrives in single precision.
    """
    states, controls = plan
    state = np.broadcast_to(states[0], (len(pushes), states.shape[1]))
    errors = [state - states[0]]
    for step, gain in enumerate(gains):
        seen = state.astype(np.float32).astype(float) - states[step]
        control = np.clip((controls[step] + seen @ gain.T).astype(np.float32), *limits)
        control = control.astype(float)
        state = hold_step(system, state, control, period, pushes[:, step])
        errors.append(state - states[step + 1])
    return np.stack(errors, axis=1)


def slopes(system, period, states, controls, gains, pushes):
    """Return A (..., N, n, n) and E (..., N, n, n) of the closed loop along flown states."""
    n, m = system.state_dim, system.control_dim
    arrays = [components(np.ascontiguousarray(part)) for part in (states, controls, pushes)]
    seeds = dual.seed([part for group in arrays for part in group])
    ended = rk4_hold(system, seeds[:n], seeds[n : n + m], seeds[n + m :], period, functions)
    found = dual.gradients(list(ended), 2 * n + m, states.shape[:-1])
    by_state = found[..., :n] + found[..., n : n + m] @ gains
    return by_state, found[..., n + m :]


def aimed(system, period, plan, gains, directions, bound, instants, pushes=None):
    """Return pushes (q, N, n) that are the worst of the loop linearised along a plan, or flights.

    Each of the directions (q, n) is aimed at for an instant of its own. Where there are flights to
    linearise along, this is a step of gradient ascent, as long as it can be.
    """
    states, controls = plan
    along = np.zeros((1, *states[1:].shape)) if pushes is None else pushes
    error = flown(system, period, plan, gains, along)[:, :-1]
    control = controls + np.einsum("kmn,qkn->qkm", gains, error)
    by_state, by_push = slopes(system, period, states[:-1] + error, control, gains, along)
    shape = len(directions), *by_state.shape[1:]
    by_state, by_push = np.broadcast_to(by_state, shape), np.broadcast_to(by_push, shape)
    found = np.zeros(shape[:3])
    pull = np.zeros(directions.shape)
    for step in range(len(gains) - 1, -1, -1):
        pull = np.where((np.asarray(instants) == step + 1)[:, None], directions, pull)
        found[:, step] = np.einsum("qij,qi->qj", by_push[:, step], pull)
        pull = np.einsum("qij,qi->qj", by_state[:, step], pull)
    return in_ball(found, bound)


def hostile(system, period, plan, gains, bound, rng, count=20, rounds=3):
    """Return pushes of all sorts: random, constant, switching, aimed, and climbed from these."""
    steps, _, n = gains.shape
    random = rng.normal(size=(count, steps, n))
    constant = np.repeat(rng.normal(size=(count, 1, n)), steps, axis=1)
    pieces = np.repeat(rng.normal(size=(count, 6, n)), -(-steps // 6), axis=1)[:, :steps]
    some = in_ball(np.concatenate([random, constant, pieces]), bound)
    directions = np.concatenate([np.eye(n), -np.eye(n), rng.normal(size=(count, n))])
    instants = rng.integers(1, steps + 1, len(directions))
    instants[: 2 * n] = steps
    pushes = aimed(system, period, plan, gains, directions, bound, instants)
    found = [some, pushes]
    for _ in range(rounds):
        pushes = aimed(system, period, plan, gains, directions, bound, instants, pushes)
        found.append(pushes)
    return np.concatenate(found)
