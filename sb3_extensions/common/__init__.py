"""What all algorithms share besides: checkpoints, seeds, augmentation, names of the numbers of an action."""
