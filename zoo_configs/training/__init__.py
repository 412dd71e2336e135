"""Training one cell: its run folder, rl_zoo3's manager, evaluation and logs."""
