"""Parts shared by the algorithms: networks, replay, augmentation, imitation losses."""
