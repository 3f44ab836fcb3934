"""Tubes around plans: flights never leave them, a smaller one is left, a wrong one is caught."""

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.numbers import functions
from lagros_envs.task import Scenario
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.pvtol.physics import Pvtol
from lagros_policies.contraction.feedback import riccati_gains
from lagros_policies.expert import Expert
from lagros_policies.learning.dataset import ExpertDataSettings
from lagros_policies.learning.tubes import tube_states
from lagros_policies.proof import hold_error, remainder
from lagros_policies.proof.error_set import ErrorSet, boxed
from lagros_policies.proof.hold_error import HoldOfErrors
from lagros_policies.proof.plan_tube import curved, plan_tubes
from lagros_policies.proof.steering import LinearGain, Steering
from tests.policies.plan_flights import aimed, flown, hostile, in_ball, slopes
from tests.policies.toys import Car, Puck, Slide

PERIOD = 0.1
LOOPS = {
    "pole": (CartPole(), [0.0, 0.5, 0.0, -0.5], [3.0, 1.0, 1.0, 1.0], [0.03], 0.15),
    "car": (Car(), [0.0, 0.0, 0.4, 1.5], [1.0, 1.0, 0.3, 0.3], [1.0, 1.0], 0.1),
    "rotors": (Pvtol(), np.zeros(6), [1.0, 1.0, 0.3, 0.3, 0.3, 0.03], [10.0, 10.0], 0.1),
}


def loop(name, steps=25, seed=0):
    """Return a system, a plan that obeys it, its gains and a bound."""
    system, start, state, control, bound = LOOPS[name]
    rng = np.random.default_rng(seed)
    centre = getattr(system, "hover", 0.0)
    scale = {"pole": 0.0, "car": 0.5, "rotors": 0.05}[name]
    controls = centre + scale * rng.normal(size=(steps, system.control_dim))
    states = [np.asarray(start, float)]
    for step in range(steps):
        if name == "pole":
            # Whatever brings it up: the plan itself is of no interest.
            controls[step] = [1.0, 18.0, 1.5, 4.0] @ states[-1]
        states.append(hold_step(system, states[-1], controls[step], PERIOD))
    states = np.array(states)
    _, by_state, by_control = linearise_hold(system, states[:-1], controls, PERIOD)
    gains = -riccati_gains(
        by_state, by_control, np.tile(state, (steps + 1, 1)), np.tile(control, (steps, 1))
    )
    return system, (states, controls), gains, bound


def tube(system, plan, gains, bound, **options):
    states, controls = plan
    return plan_tubes(system, PERIOD, states[None], controls[None], gains[None], bound, **options)


@pytest.mark.parametrize("name", LOOPS)
def test_no_flight_leaves_its_tube_and_some_come_near(name):
    system, plan, gains, bound = loop(name)
    rng = np.random.default_rng(1)
    directions = np.concatenate([np.eye(system.state_dim), rng.normal(size=(3, system.state_dim))])
    found = tube(system, plan, gains, bound, directions=directions)
    assert found.closed[0]
    errors = flown(system, PERIOD, plan, gains, hostile(system, PERIOD, plan, gains, bound, rng))
    assert np.all(np.abs(errors @ directions.T).max(axis=0) <= found.outputs[0])
    lengths = np.linalg.norm(errors, axis=-1).max(axis=0)
    assert np.all(lengths <= found.norm[0])
    assert lengths[-1] > 0.6 * found.norm[0, -1]
    moved = np.abs(np.einsum("kmn,fkn->fkm", gains, errors[:, :-1])).max(axis=0)
    assert np.all(moved <= found.deviation[0])


@pytest.mark.parametrize("name", LOOPS)
def test_a_tube_that_is_a_tenth_too_small_is_left(name):
    system, plan, gains, _ = loop(name)
    bound = 0.01
    found = tube(system, plan, gains, bound)
    directions = np.eye(system.state_dim)
    instants = np.argmax(found.outputs[0], axis=0)
    pushes = aimed(system, PERIOD, plan, gains, directions, bound, instants)
    errors = np.abs(flown(system, PERIOD, plan, gains, pushes))
    reached = errors[np.arange(len(instants)), instants, np.arange(len(instants))]
    assert np.all(reached > 0.9 * found.outputs[0].max(axis=0))
    assert np.all(reached <= found.outputs[0].max(axis=0))


def test_of_a_linear_system_the_tube_is_the_sum_of_support_functions():
    system, rng = Puck(), np.random.default_rng(2)
    steps, bound = 20, 0.3
    controls = rng.normal(size=(steps, 2))
    states = [rng.normal(size=4)]
    for control in controls:
        states.append(hold_step(system, states[-1], control, PERIOD))
    plan = np.array(states), controls
    gains = np.tile(-np.array([[2.0, 0.1, 1.5, 0.0], [0.3, 2.0, 0.0, 1.0]]), (steps, 1, 1))
    by_state, by_push = slopes(system, PERIOD, plan[0][:-1], controls, gains, np.zeros((steps, 4)))
    direction = rng.normal(size=4)
    expected, pull = 0.0, direction
    for step in range(steps - 1, -1, -1):
        expected += bound * np.linalg.norm(by_push[step].T @ pull)
        pull = by_state[step].T @ pull
    found = tube(system, plan, gains, bound, directions=direction[None])
    # Single precision of the observation and of the action is all that is added.
    assert expected <= found.outputs[0, -1, 0] <= expected + 3e-5


def test_the_error_between_the_instants_is_that_of_the_motion():
    system, plan, gains, bound = loop("pole", 10)
    rng = np.random.default_rng(3)
    found = tube(system, plan, gains, bound)
    pushes = hostile(system, PERIOD, plan, gains, bound, rng, 10, 1)
    errors = flown(system, PERIOD, plan, gains, pushes)
    worst = np.zeros(found.between.shape[1:])
    for step, gain in enumerate(gains):
        state = plan[0][step] + errors[:, step]
        control = plan[1][step] + errors[:, step] @ gain.T
        planned = plan[0][step]
        for _ in range(50):
            state = hold_step(system, state, control, PERIOD / 50, pushes[:, step])
            planned = hold_step(system, planned, plan[1][step], PERIOD / 50)
            worst[step] = np.maximum(worst[step], np.abs(state - planned).max(axis=0))
    assert np.all(worst <= found.between[0])
    # Not the instants alone: the ends of holds are less than what is claimed, by a little.
    assert np.all(found.between[0] < np.maximum(found.outputs[0, 1:], found.outputs[0, :-1]) + 0.3)


def test_a_wrong_gain_is_caught():
    system, plan, gains, _ = loop("pole")
    bound = 0.05
    found = tube(system, plan, gains, bound)
    rng = np.random.default_rng(4)
    for wrong in (0.8 * gains, 1.3 * gains):
        errors = flown(
            system, PERIOD, plan, wrong, hostile(system, PERIOD, plan, wrong, bound, rng)
        )
        assert np.any(np.abs(errors).max(axis=0) > found.outputs[0])


def wide_set(rng, n, size):
    """Return an error set with centre, balls and segments, and many of its members."""
    balls = size * rng.normal(size=(1, n, 3, n)) / 3.0
    segments = size * rng.normal(size=(1, n, 2)) / 3.0
    found = ErrorSet(0.3 * size * rng.normal(size=(1, n)), balls, segments)
    directions = rng.normal(size=(4000, n))
    # Points of the surface: where directions are supported.
    pulls = np.einsum("di,ijq->djq", directions, balls[0])
    pulls /= np.linalg.norm(pulls, axis=-1, keepdims=True)
    members = found.centre[0] + np.einsum("ijq,djq->di", balls[0], pulls)
    return found, members + np.sign(directions @ segments[0]) @ segments[0].T


def one_hold(monkeypatch=None, wrong=None, size=0.15, seed=0, angle=0.5):
    """Return by how much errors after one hold exceed their set, in many directions."""
    rng = np.random.default_rng(seed)
    system, bound, n = CartPole(), 0.5, 4
    state, control = np.array([[0.0, angle, 0.3, -angle]]), np.array([[8.0 * angle]])
    gain = np.array([[[1.5, 22.0, 3.0, 5.0]]])
    following = hold_step(system, state, control, PERIOD)
    errors, members = wide_set(rng, n, size)
    bends = curved(system, PERIOD, np.stack([state, following], axis=1), control[:, None])
    hold = HoldOfErrors(system, PERIOD, bound, np.ones(n, bool), bends)
    if wrong:
        monkeypatch.setattr(hold_error, *wrong)
    steering = LinearGain(gain[:, None]).steering(0, errors, state, control)
    after, known = hold.following(errors, steering, state, control, following)
    assert known[0]
    pushes = in_ball(rng.normal(size=members.shape), bound)
    flown_to = hold_step(system, state + members, control + members @ gain[0].T, PERIOD, pushes)
    directions = rng.normal(size=(200, n))
    directions = np.concatenate([directions, np.eye(n)])
    reach = after.support(directions[None])[0]
    middle = directions @ after.centre[0]
    off = np.abs((flown_to - following) @ directions.T - middle).max(axis=0)
    return np.max(off / reach)


def test_no_error_leaves_the_set_after_one_hold_of_a_wide_set():
    for seed in range(5):
        assert 0.5 < one_hold(seed=seed) <= 1.0


def test_polynomials_of_a_hold_and_their_rest_enclose_what_flint_proves_of_the_step():
    flint = pytest.importorskip("flint")
    rng, system, n = np.random.default_rng(14), CartPole(), 4
    state, control = np.array([[0.0, 0.5, 0.25, -0.5]]), np.array([[4.0]])
    hold = HoldOfErrors(system, PERIOD, 0.5, np.ones(n, bool), np.arange(5) > 0)
    errors, _ = wide_set(rng, n, 0.15)
    gain = np.array([[[1.5, 22.0, 3.0, 5.0]]])
    steering = Steering(gain, np.zeros((1, 1)), np.full((1, 1), 0.1))
    domain = hold_error._Domain.around(errors, steering, hold.drift, hold.curved)
    ended = hold._ended(domain, np.concatenate([state, control], axis=1))
    kept = hold.monomials
    before, flint.ctx.prec = flint.ctx.prec, 200
    try:
        for _ in range(20):
            ball, push = rng.normal(size=(2, 4))
            point = np.concatenate([ball, rng.uniform(-1.0, 1.0, 1), push])
            point[:4] *= 0.999 / np.linalg.norm(ball)
            point[5:] *= 0.999 / np.linalg.norm(push)
            y = [flint.arb(float(one)) for one in point]
            numbers = [flint.arb(float(state[0, 0])) + flint.arb(float(domain.width[0, 0])) * y[4]]
            for row, place in zip(domain.scale[0], [*state[0, 1:], control[0, 0]], strict=True):
                moved = sum(flint.arb(float(b)) * one for b, one in zip(row, y[:4], strict=True))
                numbers.append(flint.arb(float(place)) + moved)
            pushes = [flint.arb(hold.bound) * one for one in y[5:]]
            # The variables are of the state half-way through the hold, but for what moves it.
            half = flint.arb(0.5 * PERIOD)
            numbers[:4] = [one - half * d for one, d in zip(numbers[:4], pushes, strict=True)]
            true = rk4_hold(system, numbers[:4], numbers[4:], pushes, PERIOD, functions)
            for value, model in zip(true, ended, strict=True):
                total = flint.arb(0)
                for exponent, part in zip(kept.exponents.tolist(), model.parts[:, 0], strict=True):
                    term = flint.arb(float(part))
                    for power, one in zip(exponent, y, strict=True):
                        term = term * one**power
                    total = total + term
                assert abs(value - total) <= flint.arb(float(model.rest[0]))
    finally:
        flint.ctx.prec = before


def test_a_wrong_sign_in_a_remainder_is_caught(monkeypatch):
    def wrong_middle(forms):
        middle, radius = remainder.quadratic_range(forms)
        return -middle, radius

    found = max(one_hold(monkeypatch, ("quadratic_range", wrong_middle), seed=s) for s in range(5))
    assert found > 1.0


def test_a_remainder_that_is_left_out_is_caught(monkeypatch):
    def nothing(forms):
        lines, left = remainder.cubic_lines(forms)
        return 0.0 * lines, 0.0 * left

    wrong = "cubic_lines", nothing
    found = max(one_hold(monkeypatch, wrong, 0.2, seed, 0.0) for seed in range(5))
    assert found > 1.0


def test_of_no_disturbance_there_is_almost_no_tube():
    system, plan, gains, _ = loop("pole")
    assert tube(system, plan, gains, 0.0).norm.max() < 1e-4


def test_where_a_tube_does_not_close_the_others_do():
    system, plan, gains, bound = loop("pole")
    states, controls = np.stack([plan[0]] * 3), np.stack([plan[1]] * 3)
    wide = np.zeros((3, 4))
    wide[1] = 3.0
    found = plan_tubes(system, PERIOD, states, controls, np.stack([gains] * 3), bound, initial=wide)
    assert found.closed.tolist() == [True, False, True]
    assert np.isinf(found.outputs[1, -1]).all()
    assert np.isinf(found.between[1, -1]).all()
    # Their places in a batch may change how their sums are rounded.
    np.testing.assert_allclose(found.outputs[0], found.outputs[2], rtol=1e-9)


def test_of_more_plans_than_fit_together_all_holds_are_told():
    system, plan, gains, bound = loop("pole", steps=3)
    heard = []
    many = (np.stack([part] * 65) for part in (*plan, gains))
    plan_tubes(system, PERIOD, *many, bound, tell=lambda done, of: heard.append((done, of)))
    # The last of the first pieces is the first of the next.
    assert heard == [(done, 6) for done in (0, 1, 2, 3, 3, 4, 5, 6)]


def test_what_limits_take_of_the_control_counts():
    system, plan, gains, bound = loop("pole", 15)
    rng = np.random.default_rng(6)
    free = tube(system, plan, gains, bound)
    most = 0.9 * np.max(np.abs(plan[1][1:]) + free.deviation[0, 1:])
    found = tube(system, plan, gains, bound, control_low=-most, control_high=most)
    assert np.all(found.outputs >= free.outputs * (1.0 - 1e-9))
    assert found.outputs.max() > free.outputs.max()
    pushes = hostile(system, PERIOD, plan, gains, bound, rng)
    errors = flown(system, PERIOD, plan, gains, pushes, (-most, most))
    assert np.all(np.abs(errors).max(axis=0) <= found.outputs[0])


def test_channels_that_are_not_disturbed_give_a_smaller_tube():
    system, plan, gains, bound = loop("pole")
    found = tube(system, plan, gains, bound, channels=(False, False, True, True))
    assert np.all(found.norm[0, 1:] < tube(system, plan, gains, bound).norm[0, 1:])
    pushes = hostile(system, PERIOD, plan, gains, bound, np.random.default_rng(7))
    pushes[..., :2] = 0.0
    errors = flown(system, PERIOD, plan, gains, pushes)
    assert np.all(np.abs(errors).max(axis=0) <= found.outputs[0])


class Uncertain:
    """A law that is known up to a radius which grows with the error."""

    def __init__(self, gains, share):
        self.gains, self.share = gains, share

    def steering(self, step, errors, state, control):
        gain = self.gains[None, step]
        offset = np.einsum("pij,pj->pi", gain, errors.centre)
        return Steering(gain, offset, self.share * errors.radius[:, :1] + 1e-5)


def test_any_law_that_can_be_enclosed_has_a_tube():
    system, plan, gains, bound = loop("pole", 15)
    states, controls = plan
    found = plan_tubes(system, PERIOD, states[None], controls[None], Uncertain(gains, 2.0), bound)
    rng = np.random.default_rng(8)
    pushes = hostile(system, PERIOD, plan, gains, bound, rng)
    state = np.broadcast_to(states[0], (len(pushes), 4))
    for step in range(15):
        error = state - states[step]
        extra = 2.0 * np.abs(error[:, :1]) * rng.choice([-1.0, 1.0], (len(error), 1))
        control = controls[step] + error @ gains[step].T + extra
        state = hold_step(system, state, control, PERIOD, pushes[:, step])
        assert np.all(np.abs(state - states[step + 1]).max(axis=0) <= found.outputs[0, step + 1])


def test_supports_and_norms_of_a_set_are_those_of_its_members():
    found, members = wide_set(np.random.default_rng(9), 4, 1.0)
    directions = np.random.default_rng(10).normal(size=(1, 50, 4))
    off = members - found.centre[0]
    assert np.all((off @ directions[0].T).max(axis=0) <= found.support(directions)[0])
    longest = np.linalg.norm(members, axis=1).max()
    assert longest <= found.norm()[0] <= 1.35 * longest
    assert np.all(np.abs(boxed(np.ones((1, 4)), 2).radius - 1.0) < 1e-9)


@pytest.mark.parametrize("size", [2, 3, 5])
def test_forms_over_the_ball_are_enclosed(size):
    rng = np.random.default_rng(11)
    points = rng.normal(size=(20_000, size))
    points *= rng.random((20_000, 1)) ** rng.choice([0.0, 0.5], (20_000, 1))
    points /= np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1.0)
    square = rng.normal(size=(6, size, size))
    square = square + np.swapaxes(square, 1, 2)
    middle, radius = remainder.quadratic_range(square)
    values = np.einsum("di,kij,dj->kd", points, square, points)
    assert np.all(np.abs(values - middle[:, None]).max(axis=1) <= radius)
    cubes = rng.normal(size=(6, size, size, size))
    cubes = sum(
        np.transpose(cubes, (0, *np.add(order, 1)))
        for order in np.ndindex(3, 3, 3)
        if len(set(order)) == 3
    )
    lines, left = remainder.cubic_lines(cubes)
    values = np.einsum("di,dj,dk,nijk->nd", points, points, points, cubes)
    off = np.abs(values - lines @ points.T).max(axis=1)
    assert np.all(off <= left)


def inner_sum(rng):
    """Return blocks of a sum of balls and segments inside the unit ball, and its members."""
    balls, segments = rng.normal(size=(1, 4, 5, 4)), rng.normal(size=(1, 4, 6))
    # Longer in some directions, as sets of errors are.
    balls *= np.array([3.0, 1.0, 1.0, 0.3])[None, :, None, None]
    scale = np.linalg.cholesky(ErrorSet.ellipsoid(balls, segments)[0] * (1.0 + 1e-9))
    balls = np.linalg.solve(scale, balls.reshape(1, 4, -1)).reshape(balls.shape)
    segments = np.linalg.solve(scale, segments)
    found = ErrorSet(np.zeros((1, 4)), balls, segments)
    blocks = [
        np.einsum("piju,pkju->pjik", balls, balls),
        np.einsum("pij,pkj->pjik", segments, segments),
    ]
    directions = rng.normal(size=(40_000, 4))
    pulls = np.einsum("di,ijq->djq", directions, balls[0])
    pulls /= np.linalg.norm(pulls, axis=-1, keepdims=True)
    members = np.einsum("ijq,djq->di", balls[0], pulls)
    members += np.sign(directions @ segments[0]) @ segments[0].T
    assert np.all(members @ directions[0] <= found.support(directions[None, :1])[0])
    return np.concatenate(blocks, axis=1), members


def test_squares_over_a_sum_inside_the_ball_are_enclosed_more_closely():
    rng = np.random.default_rng(15)
    blocks, members = inner_sum(rng)
    square = rng.normal(size=(1, 30, 4, 4))
    square = square + np.swapaxes(square, 2, 3)
    wide = remainder.quadratic_range(square)
    middle, radius = remainder.narrower_range(square, *wide, blocks)
    values = np.einsum("di,kij,dj->kd", members, square[0], members)
    values = np.concatenate([values, np.zeros((30, 1))], axis=1)
    assert np.all(np.abs(values - middle[0, :, None]).max(axis=1) <= radius[0])
    reached = 0.5 * (values.max(axis=1) - values.min(axis=1))
    # Nearer to what is reached than the ball.
    assert np.all(radius <= wide[1] * (1.0 + 1e-9))
    assert np.median(radius[0] / reached) < 0.93 * np.median(wide[1][0] / reached)


def test_cubes_over_a_sum_inside_the_ball_are_enclosed_more_closely():
    rng = np.random.default_rng(16)
    blocks, members = inner_sum(rng)
    slopes = rng.normal(size=(30, 4))
    # Products of three slopes, two of them alike: what the cubic of a tilting body is like.
    other = slopes + 0.3 * rng.normal(size=(30, 4))
    cubes = np.einsum("ka,kb,kc->kabc", slopes, slopes, other)
    cubes = sum(np.moveaxis(cubes, 3, axis) for axis in (1, 2, 3))[None]
    wide = remainder.cubic_lines(cubes)
    lines, left = remainder.narrower_lines(cubes, *wide, blocks)
    values = np.einsum("di,dj,dk,nijk->nd", members, members, members, cubes[0], optimize=True)
    inner = rng.random((1, len(members)))
    for share in (np.ones_like(inner), inner):
        off = np.abs(share**3 * values - share * (lines[0] @ members.T)).max(axis=1)
        assert np.all(off <= left[0])
    assert np.all(left <= wide[1])
    assert np.mean(left < 0.95 * wide[1]) > 0.2


def test_a_cube_follows_three_quarters_of_a_line():
    cube = np.zeros((1, 2, 2, 2))
    cube[0, 0, 0, 0] = 1.0
    lines, left = remainder.cubic_lines(cube)
    assert np.abs(lines[0]) == pytest.approx([0.75, 0.0], abs=0.03)
    assert 0.25 <= left[0] <= 0.28


@pytest.mark.parametrize(
    ("name", "expected"),
    [("pole", [0, 1, 1, 1, 1]), ("car", [0, 0, 1, 1, 1, 1]), ("rotors", [0, 0, 1, 1, 1, 1, 1, 1])],
)
def test_what_a_hold_is_not_affine_in_is_found(name, expected):
    system, (states, controls), _, _ = loop(name)
    assert curved(system, PERIOD, states[None], controls[None]).tolist() == expected


def test_what_does_not_fit_is_refused():
    system, (states, controls), gains, bound = loop("pole", 5)
    arrays = states[None], controls[None], gains[None]
    with pytest.raises(ValueError, match="feedback"):
        plan_tubes(system, PERIOD, *arrays[:2], gains, bound)
    with pytest.raises(ValueError, match="controls"):
        plan_tubes(system, PERIOD, arrays[0], controls[None, 1:], arrays[2], bound)
    with pytest.raises(ValueError, match="bound"):
        plan_tubes(system, PERIOD, *arrays, -0.1)
    with pytest.raises(ValueError, match="finite"):
        plan_tubes(system, PERIOD, np.nan * arrays[0], *arrays[1:], bound)
    with pytest.raises(ValueError, match="directions"):
        plan_tubes(system, PERIOD, *arrays, bound, directions=np.eye(3))


def test_the_states_that_a_network_learns_from_lie_in_the_tube():
    task, settings = Slide(), ExpertDataSettings(disturbance_bound=0.5, spread=0.0)
    expert, rng = Expert(task), np.random.default_rng(13)
    asked = Scenario(np.zeros(4), np.array([4.0, 0.5, 0.0, 0.0]))
    plan = expert.planner.plan(asked.initial_state, asked.goal)
    tracked = expert.track(np.stack([plan.states] * 40), np.stack([plan.controls] * 40))
    found = tube(task.system, (plan.states, plan.controls), tracked.feedback[0], 0.5)
    states, _, step = tube_states(rng, expert, tracked, settings)
    share = np.abs(states - plan.states[step])[step > 5] / found.outputs[0, step[step > 5]]
    assert 0.4 < share.max() <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_twenty_thousand_flights_never_leave(name):
    system, plan, gains, bound = loop(name, 60)
    found = tube(system, plan, gains, bound)
    rng = np.random.default_rng(12)
    flights = 0
    # Many that are aimed at the loop linearised along the plan, some that climb from there.
    for count, rounds in [(1000, 0)] * 4 + [(60, 5)] * 7:
        pushes = hostile(system, PERIOD, plan, gains, bound, rng, count, rounds)
        errors = flown(system, PERIOD, plan, gains, pushes)
        assert np.all(np.abs(errors).max(axis=0) <= found.outputs[0])
        assert np.all(np.linalg.norm(errors, axis=-1).max(axis=0) <= found.norm[0])
        flights += len(pushes)
    assert flights > 20_000
