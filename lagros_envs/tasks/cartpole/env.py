"""`lagros/CartPole-v0`: bring a cart with a falling pole to a place, under bounded disturbance."""

from __future__ import annotations

from lagros_envs.env import TaskEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings


class CartPoleEnv(TaskEnv):
    """Cart-pole with a continuous force, held for 0.1 s, and a bounded disturbance of the state.

    What is not said here is as in `TaskEnv`.

    ## Action
    One number, `Box(-1, 1, (1,))`: the force on the cart in units of `settings.force_scale`
    (40 N). Actions beyond +-1 are applied as they are, unless `settings.force_limit` is set, up to
    `lagros_envs.task.LARGEST_CONTROL`.

    ## Observation
    A flat float32 vector of 13; `gymnasium.spaces.unflatten(env.unwrapped.named_space, obs)` names
    its parts:

    | index | part            | content                                            |
    |-------|-----------------|----------------------------------------------------|
    | 0-3   | `state`         | x = [p, theta, dp/dt, dtheta/dt] [m, rad, m/s, rad/s] |
    | 4-7   | `goal`          | x_f = [p_f, 0, 0, 0]                               |
    | 8-11  | `initial_state` | x(0)                                               |
    | 12    | `time`          | t [s]                                              |

    ## Reward
    Minus effort and distance to the goal, plus a bonus for every step upright and one for the first
    success, with the weights of `CartPoleSettings`.

    ## Starting state
    theta_0 uniform in +-60 degrees at rest, goal p_f uniform in +-5 m. `reset(options=...)` takes
    `initial_state`, `goal` (also p_f alone) and `nominal` (x_d at every control instant, shape
    (91, 4)).

    ## Episode end
    `terminated` when |theta| > pi/2; `truncated` at 9 s. The paper counts the first entry into the
    tube, the strict measure looks at the end.

    ## Info
    `tube_radius` is r(t), the radius of the published tube, and `goal_distance` ||x - x_f||.
    """

    task_name = "cartpole"
    settings: CartPoleSettings
