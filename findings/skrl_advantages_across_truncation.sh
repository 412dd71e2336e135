#!/usr/bin/env bash
# skrl 2.1.1: PPO includes the rewards of the next episode in the returns of a truncated episode.
# This is so with the default time_limit_bootstrap=False.
# compute_gae() stops at terminations only. The documentation of PPO computes it from "terminated or truncated", and the option is
# described as "Whether to bootstrap at timeout termination". Only True also separates the episodes. A2C, RPO and AMP are alike.
# Seen for two episodes that are truncated after 2 steps with reward 1 (no discount, all values 0): returns 4, 3, 2, 1; with True
# 2, 1, 2, 1, which is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    skrl==2.1.1 torch==2.13.0 gymnasium==1.4.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import gymnasium
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import categorical_model, deterministic_model

network = [{"name": "net", "input": "OBSERVATIONS", "layers": [8], "activations": "relu"}]
returns = {}
for bootstrap in (False, True):
    env = wrap_env(gymnasium.make("CartPole-v1", max_episode_steps=2))  # the pole does not fall in 2 steps
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": "cpu"}
    policy = categorical_model(**spaces, network=network, output="ACTIONS")
    value = deterministic_model(**spaces, network=network, output="ONE")
    value.init_state_dict(role="value")  # gives lazy layers their sizes
    for parameter in value.parameters():
        parameter.data.zero_()
    memory = RandomMemory(memory_size=4, device="cpu")
    cfg = PPO_CFG(rollouts=4, discount_factor=1.0, gae_lambda=1.0, time_limit_bootstrap=bootstrap)
    agent = PPO(models={"policy": policy, "value": value}, memory=memory, cfg=cfg, **spaces)
    SequentialTrainer(cfg={"timesteps": 4, "headless": True}, env=env, agents=agent).train()
    returns[bootstrap] = memory.get_tensor_by_name("returns").flatten().tolist()
print(returns)
assert returns == {False: [4.0, 3.0, 2.0, 1.0], True: [2.0, 1.0, 2.0, 1.0]}
PYTHON
