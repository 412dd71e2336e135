"""Physical properties of bodies that tasks may change, as part of the state."""

import math
from dataclasses import dataclass, replace
from typing import Any

from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.shapes import BodySpec, Colour

NUMBERS = ("mass", "friction", "rolling_friction", "spinning_friction", "restitution")


@dataclass(frozen=True)
class Properties:
    """Physical properties of a body that a task may change at a reset.

    :param mass: kg; 0 for a fixed body
    :param friction: lateral friction coefficient
    :param rolling_friction: coefficient against rolling (m)
    :param spinning_friction: coefficient against spinning in place (m)
    :param restitution: share of the approach speed with which it rebounds, at most
    :param colour: red, green, blue and opacity, 0 to 1
    """

    mass: float
    friction: float
    rolling_friction: float
    spinning_friction: float
    restitution: float
    colour: Colour

    @classmethod
    def of(cls, spec: BodySpec) -> "Properties":
        """Return the properties that a body is loaded with."""
        frictions = (spec.friction, spec.rolling_friction, spec.spinning_friction)
        return cls(spec.mass, *frictions, 0.0, spec.colour)

    def changed(self, **changes: Any) -> "Properties":
        """Return the properties with some of them changed.

        :raises TypeError: an unknown property
        """
        made = replace(self, **changes)
        numbers: dict[str, Any] = {name: float(getattr(made, name)) for name in NUMBERS}
        return Properties(**numbers, colour=tuple(map(float, made.colour)))  # type: ignore[arg-type]

    def check(self, spec: BodySpec) -> None:
        """Check the properties for a body.

        :raises ValueError: one of them is out of range
        """
        for name in NUMBERS[1:]:
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
        if not ((spec.mass > 0.0) == (self.mass > 0.0) and 0.0 <= self.mass < math.inf):
            wants = "a positive number" if spec.mass > 0.0 else "0 for a fixed body"
            raise ValueError(f"mass must be {wants}, got {self.mass!r}")
        if len(self.colour) != 4 or not all(0.0 <= part <= 1.0 for part in self.colour):
            raise ValueError(f"colour must be 4 numbers from 0 to 1, got {self.colour!r}")


def set_dynamics(client: Client, body_id: int, spec: BodySpec, properties: Properties) -> None:
    """Give a body its frictions, restitution and mass, the inertia in proportion to the mass."""
    inertia: dict[str, Any] = {}
    if spec.mass > 0.0:
        moments = [moment * (properties.mass / spec.mass) for moment in spec.mass_properties[1]]
        inertia = {"mass": properties.mass, "localInertiaDiagonal": moments}
    client.changeDynamics(
        body_id,
        -1,
        lateralFriction=properties.friction,
        rollingFriction=properties.rolling_friction,
        spinningFriction=properties.spinning_friction,
        restitution=properties.restitution,
        **inertia,
    )
