"""Observations: views of the scene, the sensors that read them, and cameras."""

from bulletarm_gym.observations.camera_sensors import Rgb as Rgb
from bulletarm_gym.observations.observer import Observer as Observer
from bulletarm_gym.observations.rasterizer import Window as Window
from bulletarm_gym.observations.sensor import Sensor as Sensor, State as State
from bulletarm_gym.observations.view import (
    MAX_HEIGHT as MAX_HEIGHT,
    ElevationMap as ElevationMap,
    Frame as Frame,
    HeightRenderer as HeightRenderer,
    Heights as Heights,
    Overlay as Overlay,
    View as View,
)
