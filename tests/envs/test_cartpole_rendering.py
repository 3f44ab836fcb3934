"""The cart-pole as it is drawn: what is seen where, and when a window opens."""

import importlib.util
import sys

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings

pygame_only = pytest.mark.skipif(
    not importlib.util.find_spec("pygame"), reason="the extra render is missing"
)
BLUE, ORANGE, VERMILLION = (0, 114, 178), (230, 159, 0), (213, 94, 0)
FILLED = np.array([204, 231, 248])  # of the tube: 30 % of sky blue
BELOW_LEGEND = 140  # [px]
UPRIGHT = np.zeros(4)
ZERO = np.zeros(1, np.float32)


def cartpole(**settings):
    return gym.make("lagros/CartPole-v0", **settings).unwrapped


def pixels(frame, colour, top=BELOW_LEGEND):
    """Return rows and columns of the scene's pixels of a colour."""
    close = np.all(np.abs(frame[top:].astype(int) - colour) <= 12, axis=-1)
    return np.nonzero(close)


def drawn(start, goal=0.0, steps=0, **settings):
    env = cartpole(render_mode="rgb_array", **settings)
    env.reset(seed=0, options={"initial_state": start, "goal": goal})
    for _ in range(steps):
        env.step(ZERO)
    frame = env.render()
    env.close()
    return frame


@pygame_only
def test_frames_are_rgb_and_change():
    env = gym.make("lagros/CartPole-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (400, 800, 3)
    assert first.dtype == np.uint8
    env.step(np.ones(1, np.float32))
    second = env.render()
    assert np.any(first != second)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), first)
    env.close()


@pygame_only
@pytest.mark.parametrize("position", [-12.0, -3.0, 0.0, 3.0, 12.0])
@pytest.mark.parametrize("goal", [-5.0, 5.0])
def test_the_cart_is_always_in_view(position, goal):
    rows, columns = pixels(drawn([position, 0.0, 0.0, 0.0], goal), BLUE)
    assert rows.size > 50
    assert columns.min() > 40
    assert columns.max() < 760
    assert (columns.mean() > 400) == (position > goal)


@pygame_only
@pytest.mark.parametrize("angle", [-1.2, 1.2])
def test_the_pole_leans_to_the_side_of_its_angle(angle):
    frame = drawn([0.0, angle, 0.0, 0.0])
    _, cart = pixels(frame, BLUE)
    _, pole = pixels(frame, ORANGE)
    assert np.sign(pole.mean() - cart.mean()) == np.sign(angle)


@pygame_only
def test_a_longer_pole_is_drawn_longer():
    heights = []
    for half_length in (0.3, 0.6):
        system = CartPole(half_length=half_length)
        frame = drawn(UPRIGHT, settings=CartPoleSettings(system=system))
        heights.append(np.ptp(pixels(frame, ORANGE)[0]))
    assert heights[1] == pytest.approx(2.0 * heights[0], rel=0.1)


@pygame_only
def test_the_tube_grows_with_time():
    def width(frame):
        # The background of a row above the cart, away from white.
        return np.sum(np.any(frame[240] != 255, axis=-1))

    widths = [width(drawn(UPRIGHT, 0.0, steps)) for steps in (1, 5, 20, 60)]
    assert np.all(np.diff(widths) > 0)
    # 800 pixels show 7 m: r(6 s) = 3.064 m to either side.
    assert widths[-1] == pytest.approx(2 * 3.064 / 7.0 * 800, rel=0.03)


@pygame_only
@pytest.mark.parametrize("position", [0.5, 1.6, 1.9, 2.1, 2.6])
@pytest.mark.parametrize("velocity", [0.0, -1.2, 3.0])
def test_the_cart_stands_in_the_filled_band_if_and_only_if_the_state_is_in_the_tube(
    position, velocity
):
    env = cartpole(render_mode="rgb_array")
    env.reset(seed=0, options={"initial_state": UPRIGHT, "goal": 0.0})
    for _ in range(20):
        env.step(ZERO)
    env._state = (position, 0.0, velocity, 0.0)
    frame = env.render()
    env.close()
    inside = position**2 + velocity**2 <= env.settings.tube.radius(2.0) ** 2
    _, cart = pixels(frame, BLUE)
    filled = np.flatnonzero(np.all(np.abs(frame[240] - FILLED) <= 3, axis=-1))
    reached = filled.size > 0 and filled.min() <= cart.mean() <= filled.max()
    assert reached == inside


@pygame_only
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_disturbance_is_drawn_where_it_pushes(direction):
    def push(now):
        return np.array([0.0, 0.0, 0.5 * direction, 0.0])

    frame = drawn(UPRIGHT, 0.0, 1, disturbance=push, disturbance_bound=0.5)
    _, arrow = pixels(frame, VERMILLION)
    _, cart = pixels(frame, BLUE)
    assert np.sign(arrow.mean() - cart.mean()) == direction
    assert np.ptp(arrow) == pytest.approx(80, abs=4)
    calm = drawn(UPRIGHT, 0.0, 1)
    assert pixels(calm, VERMILLION)[0].size == 0


@pygame_only
def test_the_nominal_is_drawn_as_a_ghost():
    env = cartpole(render_mode="rgb_array")
    nominal = np.zeros((91, 4))
    nominal[:, 0] = 2.0
    frames = []
    for options in ({}, {"nominal": nominal}):
        env.reset(seed=0, options={"initial_state": UPRIGHT, "goal": 0.0, **options})
        frames.append(env.render())
    env.close()
    _, columns = np.nonzero(np.any(frames[0] != frames[1], axis=-1)[BELOW_LEGEND:])
    # 2 m to the right of the middle, with 800 pixels for 7 m.
    assert columns.mean() == pytest.approx(400 + 2.0 * 800 / 7.0, abs=6)


@pygame_only
def test_a_window_opens_and_closes(monkeypatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("lagros/CartPole-v0", render_mode="human")
    env.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (800, 400)
    env.step(ZERO)
    assert env.render() is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface())
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 50
    env.close()
    assert not pygame.display.get_init()


@pygame_only
def test_frames_need_no_display_and_drawing_prints_nothing(run_python):
    printed = run_python(
        "import gymnasium, lagros_envs\n"
        "env = gymnasium.make('lagros/CartPole-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0); shape = env.render().shape\n"
        "import pygame\n"
        "assert not pygame.display.get_init()\n"
        "print(shape)",
        SDL_VIDEODRIVER="none such",
    )
    assert printed == "(400, 800, 3)\n"


def test_drawing_without_pygame_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = cartpole(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(ImportError, match=r"pip install \"lagros\[render\]\""):
        env.render()


def test_render_without_a_mode_warns_and_returns_none():
    env = cartpole()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="render_mode='ansi'"):
        CartPoleEnv(render_mode="ansi")
