"""What the places of our pages are filled with, by name."""

from __future__ import annotations

from functools import partial

from zoo_configs.pages import code, collecting, experts, results, speeds
from zoo_configs.pages.markers import Figure

FIGURES: dict[str, Figure] = {
    "experts, open loop": partial(experts.expert_table, belongs=experts.is_open_loop),
    "experts, open loop, ramps and bumps": partial(experts.expert_table, belongs=experts.is_uneven),
    "experts, close loop": partial(experts.expert_table, belongs=experts.is_papers_close_loop),
    "experts, composed": partial(experts.expert_table, belongs=experts.is_composed),
    "experts, elsewhere": experts.elsewhere_table,
    "experts on the grid": experts.grid_table,
    "speed": speeds.speed_table,
    "speed, means": speeds.ratio_sentence,
    "speed, in short": speeds.ratio_summary,
    "updates, close loop": partial(speeds.update_table, belongs=lambda name: name.startswith("CloseLoop")),
    "updates, open loop": partial(speeds.update_table, belongs=lambda name: name.startswith("OpenLoop")),
    "overhead": speeds.overhead_table,
    "deconstruction": collecting.deconstruction_table,
    "code": code.code_table,
    "results, close loop": partial(results.results_table, preset="cpu", tasks="CloseLoop*"),
    "results, open loop": partial(results.results_table, preset="cpu", tasks="OpenLoop*"),
    "results, many demonstrations": partial(results.results_table, preset="quick", tasks="CloseLoop*"),
}
