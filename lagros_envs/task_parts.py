"""Parts of a task: its metric, feedback, networks, and what commands take by default."""

from __future__ import annotations

from dataclasses import dataclass

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class MetricDesign:
    """Which contraction metric a task wants, and where it has to hold (CV-STEM, Theorem 2).

    W is a sum of coefficients times `basis`, functions of x or of x_d written as in
    `lagros_policies.contraction.Basis`, such as "1", "cos(x[2])" or "x[3]**2".

    Attributes:
        low: Least x_d of the region, shape (n,).
        high: Largest x_d, shape (n,).
        error: Largest |x - x_d| of each coordinate, shape (n,).
        control_low: Least u_d, shape (m,).
        control_high: Largest u_d, shape (m,).
        basis: Functions of the point.
        point: "state": the metric is a function of x; "nominal": of x_d, for systems whose control
            moves all that the motion depends on.
        rate: Contraction rate alpha [1/s].
        scaling: Of the coordinates in the condition number, shape (n,); None for ones.
        margin: By how much the condition is asked for beyond zero [1/s].
    """

    low: Numbers
    high: Numbers
    error: Numbers
    control_low: Numbers
    control_high: Numbers
    basis: tuple[str, ...] = ("1",)
    point: str = "state"
    rate: float = 0.5
    scaling: Numbers | None = None
    margin: float = 0.1


@dataclass(frozen=True)
class Feedback:
    """Weights of the law along a plan and of the regulators, and how fast the law contracts.

    The law along a plan is the gain of the metric that a discounted Riccati recursion gives
    (`lagros_policies.contraction.along_plan`). Its weights may begin elsewhere than they settle:
    at a time t each is its own times exp(s exp(-t / settling)), s its entry of `early_state` or
    `early_control`. Weights of the control that begin high are gentle where a tube is still narrow.

    Attributes:
        state_weights: Diagonal of Q, shape (n,).
        control_weights: Diagonal of R, shape (m,).
        rate: Contraction rate alpha of the law along a plan [1/s].
        early_state: Logarithm of what Q begins with, in units of Q, shape (n,); () for zeros.
        early_control: Likewise of R, shape (m,).
        settling: Time over which the weights settle [s].
    """

    state_weights: Numbers
    control_weights: Numbers
    rate: float = 0.5
    early_state: Numbers = ()
    early_control: Numbers = ()
    settling: float = 0.5


@dataclass(frozen=True)
class Learning:
    """How the networks of a task are made (Algorithm 1, then DAgger).

    Attributes:
        plans: Random episodes with a target trajectory each.
        samples: Labelled states around them.
        disturbance_bound: Largest d_bar of the flights that fill the tube.
        hidden: Width of each hidden layer of (c) and (a); where there are discs, the first two are
            for each of them.
        epochs: Passes over the data for (c).
        learned_epochs: Likewise for (a).
        batch: Samples per step.
        rounds: Rounds of DAgger: the network flies, u* says what it should have done.
        round_plans: Episodes of each round.
        round_samples: Labelled states of each round.
        round_epochs: Passes over the data before each round.
        keeps_plan: Whether (c) learns to follow the plan from the start, as (b) does: its network
            sees where the episode began, and rounds fly the episodes of the first data and label
            what they meet around the plans of these. Else rounds plan anew from what they meet.
        scheduled: Whether (c) is affine in the state, u = c + K x with c and K made of the episode
            and the time: the form of the law itself. It needs features that are affine in it.
        slope_weight: Of the error of the slope of (c), du/dx against K, in the loss.
        mpc_samples: States labelled by planning from them, for (a) with the care that (c) gets
            (`learned-mpc`): None for as many as (c) has, 0 for no such network. They come in equal
            parts from the tube of (b) and from each of its rounds; passes are those of (c).
        mpc_rounds: Rounds of DAgger of that network.
    """

    plans: int = 1000
    samples: int = 50_000
    disturbance_bound: float = 1.0
    hidden: tuple[int, ...] = (100, 100, 100)
    epochs: int = 600
    learned_epochs: int = 150
    batch: int = 512
    rounds: int = 0
    round_plans: int = 1000
    round_samples: int = 50_000
    round_epochs: int = 20
    keeps_plan: bool = False
    scheduled: bool = False
    slope_weight: float = 0.0
    mpc_samples: int | None = None
    mpc_rounds: int = 1


@dataclass(frozen=True)
class Defaults:
    """What the commands take where the user says nothing; each stands here and nowhere else.

    Attributes:
        policies: Of `lagros bench`.
        bounds: d_bar of `lagros bench`, in units of the state per second.
        bound: d_bar of the commands that take one.
        episodes: Episodes of `lagros bench`.
        agents: Agents of each of its worlds; () for a task of one body, as in the next two.
        preset: Of `Described.presets`.
        safety_filter: "none", "all" policies use it, or "both" one after the other.
        attack_episodes: Episodes that `lagros attack` searches.
        attack_budget: Flights that it may spend on each.
        certify_policies: What `lagros certify` is about, the first by default; of many agents it
            may be asked about no other.
        certify_episodes: Episodes that it guarantees and flies.
        speed: Of the film of `lagros watch`, as a multiple of the real one.
    """

    policies: tuple[str, ...] = ("learned", "tube-mpc", "lagros", "lqr")
    bounds: Numbers = (0.75,)
    bound: float = 0.75
    episodes: int = 50
    agents: tuple[int, ...] = ()
    preset: str | None = None
    safety_filter: str = "none"
    attack_episodes: int = 10
    attack_budget: int = 1000
    certify_policies: tuple[str, ...] = ("tube-mpc", "lagros")
    certify_episodes: int = 50
    speed: float = 1.0
