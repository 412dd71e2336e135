"""Entropy coefficient of SAC and of algorithms derived from it."""

from typing import Any

import torch as th

from sb3_extensions.common.components import check_entropy


def replace_ent_coef(model: Any, ent_coef: str | float) -> None:
    """Replace the entropy coefficient of SAC or an algorithm derived from it, if it differs."""
    if ent_coef == model.ent_coef:
        return
    check_entropy(ent_coef=ent_coef)
    model.ent_coef, model.log_ent_coef, model.ent_coef_optimizer = ent_coef, None, None
    kind, _, start = str(ent_coef).partition("_")
    if kind == "auto":
        log_start = th.log(th.ones(1, device=model.device) * float(start or 1.0))
        model.log_ent_coef = log_start.requires_grad_(True)
        model.ent_coef_optimizer = th.optim.Adam([model.log_ent_coef], lr=model.lr_schedule(1))
    else:
        model.ent_coef_tensor = th.tensor(float(ent_coef), device=model.device)
