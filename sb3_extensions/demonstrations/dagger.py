"""Labels of the expert in the states that the agent visits."""

from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.callbacks import BaseCallback

from sb3_extensions.demonstrations.off_policy import OffPolicyFromDemonstrations
from sb3_extensions.replay.buffer import EXPERT_ACTION


class DaggerCallback(BaseCallback):
    """
    Query the expert before every step, so that SACfD with ``bc_weight`` also imitates it in online steps.

    The agent's action is executed. Source: DAgger, https://arxiv.org/abs/1011.0686

    :raises ValueError: at the start of ``learn()``, if the algorithm does not imitate (``bc_weight``), or the
        environment has no ``expert_action()``
    """

    model: OffPolicyFromDemonstrations
    _actions: npt.NDArray[Any] | None = None

    def _on_training_start(self) -> None:
        if not getattr(self.model, "bc_weight", 0.0):
            must, got = "SACfD with bc_weight above 0", type(self.model).__name__
            raise ValueError(f"model must be {must} for DaggerCallback, got {got}")
        if not self.training_env.has_attr("expert_action"):
            raise ValueError("env must have expert_action() for DaggerCallback, this one has none")
        self._actions = None

    def _on_rollout_start(self) -> None:
        if self._actions is None:
            self._query()

    def _on_step(self) -> bool:
        assert self._actions is not None
        for info, action in zip(self.locals["infos"], self._actions, strict=True):
            info[EXPERT_ACTION] = action
        self._query()  # in the state before the next step
        return True

    def _query(self) -> None:
        actions = np.stack(self.training_env.env_method("expert_action"))
        self._actions = self.model.as_policy_actions(actions)
