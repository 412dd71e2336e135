"""Observations: views of the scene, the sensors that read them, and cameras."""

from bulletarm_gym.observations.camera_sensors import Rgb
from bulletarm_gym.observations.observer import Observer
from bulletarm_gym.observations.rasterizer import Window
from bulletarm_gym.observations.sensor import Sensor, State
from bulletarm_gym.observations.view import (
    ElevationMap,
    Frame,
    HeightRenderer,
    Heights,
    Overlay,
    View,
)

__all__ = [
    "ElevationMap",
    "Frame",
    "HeightRenderer",
    "Heights",
    "Observer",
    "Overlay",
    "Rgb",
    "Sensor",
    "State",
    "View",
    "Window",
]
