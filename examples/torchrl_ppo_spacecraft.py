"""PPO of TorchRL on the multi-agent spacecraft, through TorchRL's PettingZoo wrapper.

    pip install "lagros[torchrl]"
    python examples/torchrl_ppo_spacecraft.py --updates 200

`PettingZooWrapper` takes `spacecraft_v0.parallel_env()` as it is. The agents, `agent_0` and so on,
form one group named `agent`, whose tensors have an axis of agents; one network acts for all of
them and another judges all of them. No mask is needed: our agents begin and end together.
"""

from __future__ import annotations

import argparse
import warnings

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from tensordict.nn import TensorDictSequential as Sequence
from torch import nn
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from lagros_envs import spacecraft_v0

GROUP = "agent"
OBSERVATION, ACTION = (GROUP, "observation"), (GROUP, "action")
RETURN = (GROUP, "episode_reward")


def make_env(agents: int, cycles: int, seed: int) -> TransformedEnv:
    """Return the environment, which also adds up the rewards of an episode."""
    with warnings.catch_warnings():
        # TorchRL is tested with an older PettingZoo and says so.
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested using version")
        wrapped = PettingZooWrapper(
            spacecraft_v0.parallel_env(
                num_agents=agents,
                preset="open",
                disturbance="uniform",
                disturbance_bound=0.4,
                max_cycles=cycles,
            ),
            seed=seed,
        )
    return TransformedEnv(wrapped, RewardSum(in_keys=[wrapped.reward_key], out_keys=[RETURN]))


def make_networks(env: TransformedEnv) -> tuple[ProbabilisticActor, TensorDictModule]:
    """Return actor and critic; the agents share the weights of each."""
    agents, inputs = env.observation_spec[OBSERVATION].shape
    thrusters = env.full_action_spec[ACTION].shape[-1]

    def network(outputs: int) -> MultiAgentMLP:
        return MultiAgentMLP(
            n_agent_inputs=inputs,
            n_agent_outputs=outputs,
            n_agents=agents,
            centralized=False,
            share_params=True,
            num_cells=[64, 64],
            activation_class=nn.Tanh,
        )

    actor = ProbabilisticActor(
        module=Sequence(
            TensorDictModule(network(thrusters), in_keys=[OBSERVATION], out_keys=[(GROUP, "loc")]),
            TensorDictModule(
                AddStateIndependentNormalScale(thrusters),
                in_keys=[(GROUP, "loc")],
                out_keys=[(GROUP, "loc"), (GROUP, "scale")],
            ),
        ),
        spec=env.full_action_spec[ACTION],
        in_keys=[(GROUP, "loc"), (GROUP, "scale")],
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        # Thrusters push with 0 to 1 N and cannot pull.
        distribution_kwargs={"low": 0.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=(GROUP, "sample_log_prob"),
    )
    critic = TensorDictModule(network(1), in_keys=[OBSERVATION], out_keys=[(GROUP, "state_value")])
    return actor, critic


def train(
    updates: int = 200, agents: int = 3, cycles: int = 200, steps: int = 1000, seed: int = 0
) -> tuple[ProbabilisticActor, list[float]]:
    """Train an actor and return it with the returns of the finished episodes, mean over agents."""
    torch.manual_seed(seed)
    env = make_env(agents, cycles, seed)
    actor, critic = make_networks(env)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0)
    loss.set_keys(
        reward=env.reward_key,
        action=ACTION,
        sample_log_prob=(GROUP, "sample_log_prob"),
        value=(GROUP, "state_value"),
        done=(GROUP, "done"),
        terminated=(GROUP, "terminated"),
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
    returns: list[float] = []
    for update in range(1, updates + 1):
        with torch.no_grad():
            batch = env.rollout(steps, actor, break_when_any_done=False)
            loss.value_estimator(batch)
            advantage = batch["advantage"]
            batch["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        ended = batch["next", "done"].squeeze(-1)
        returns += batch["next", *RETURN][ended].mean((-2, -1)).tolist()
        for _ in range(8):
            for part in torch.randperm(steps).chunk(4):
                losses = loss(batch[part])
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        if returns:
            last = returns[-20:]
            print(f"update {update}: {len(returns)} episodes, last: {sum(last) / len(last):.1f}")
    env.close()
    return actor, returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (
        ("updates", 200),
        ("agents", 3),
        ("cycles", 200),
        ("steps", 1000),
        ("seed", 0),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    train(**vars(parser.parse_args()))
