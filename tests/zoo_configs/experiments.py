"""All experiments, and those of the golden file."""

from zoo_configs.environments import our_env_ids, register_environments
from zoo_configs.experiments.families import families

register_environments()
ALL = [
    (baseline, preset, env_id)
    for env_id in our_env_ids()
    for family in families()
    if family.has_env(env_id)
    for baseline in family.baselines
    for preset in family.presets
    if family.has_experiment(baseline, env_id)
]
"""Baseline, preset and environment id of each experiment."""
