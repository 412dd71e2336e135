"""A scripted policy for LeRobot that moves the gripper to the first object, for tests of the plug-in."""

from dataclasses import dataclass

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

STEP = 0.05
"""Translation (m) of an action of 1."""


@PreTrainedConfig.register_subclass("scripted")
@dataclass
class ScriptedConfig(PreTrainedConfig):
    """Configuration without parameters."""

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self):
        raise NotImplementedError

    def get_scheduler_preset(self):
        raise NotImplementedError

    def validate_features(self):
        pass


class ScriptedPolicy(PreTrainedPolicy):
    """Move towards the first object. It checks the observations of all steps."""

    config_class = ScriptedConfig
    name = "scripted"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        self.unused = torch.nn.Parameter(torch.zeros(1))

    def select_action(self, batch, **kwargs):
        state, objects = batch["observation.state"], batch["observation.environment_state"]
        images = batch["observation.images.front"]
        assert images.shape[1:] == (3, 48, 48) and 0.2 < float(images.max()) <= 1.0
        assert all("ove the" in task or "each" in task for task in batch["task"]), batch["task"]
        action = torch.zeros(len(state), 5)
        action[:, 0] = 1.0
        action[:, 1:4] = ((objects[:, 1:4] - state[:, 1:4]) / STEP).clamp(-1.0, 1.0)
        return action

    def reset(self):
        pass

    def get_optim_params(self):
        return self.parameters()

    def forward(self, batch):
        raise NotImplementedError

    def predict_action_chunk(self, batch, **kwargs):
        return self.select_action(batch)[:, None]


def make_scripted_pre_post_processors(config, dataset_stats=None):
    """Return processors that change nothing."""
    convert = {"to_transition": policy_action_to_transition, "to_output": transition_to_policy_action}
    return PolicyProcessorPipeline(steps=[]), PolicyProcessorPipeline(steps=[], **convert)
