"""Training of one experiment: run folder, trainer, evaluation and logs."""
