"""Asking the environment's expert in the states that an agent comes to."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.demonstrations.collecting import Actions
from sb3_extensions.demonstrations.source import Rescale
from sb3_extensions.replay.buffer import EXPERT_ACTION


class Adviser:
    """
    The expert of the training environment: it does not act, but says what it would do.

    DAgger: https://arxiv.org/abs/1011.0686

    :param rescale: from actions in the environment's units to those of the policy
    """

    def __init__(self, rescale: Rescale) -> None:
        self.rescale = rescale
        self._advice: Actions = np.empty(0)

    @staticmethod
    def check(env: VecEnv | None) -> None:
        """
        Check that there is somebody to ask.

        :param env: training environment, None if it comes later
        :raises ValueError: if it has no ``expert_action()``
        """
        if env is not None and not env.has_attr("expert_action"):
            raise ValueError("dagger=True needs an environment with expert_action(), this one has none")

    def ask(self, env: VecEnv) -> None:
        """
        Ask before a step, in the state that the environment is in.

        :param env: training environment
        """
        self._advice = self.rescale(np.stack(env.env_method("expert_action")))

    def advise(self, infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """
        Hand over what was said before the step.

        :param infos: of the step, one an environment
        :return: the same with the expert's actions, as the replay buffer takes them
        """
        return [{**info, EXPERT_ACTION: action} for info, action in zip(infos, self._advice, strict=True)]
