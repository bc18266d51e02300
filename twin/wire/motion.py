"""How an axis with limited speed and acceleration gets from one place to another, in closed form.

Positions are microsteps, speeds microsteps/s, accelerations microsteps/s².
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Phase:
    """A piece of constant acceleration: how long, and position and velocity at its beginning."""

    duration_s: float
    position: float
    velocity: float
    acceleration: float = 0.0

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Position and velocity."""
        velocity = self.velocity + self.acceleration * elapsed_s
        return self.position + (self.velocity + velocity) / 2 * elapsed_s, velocity


@dataclass(frozen=True)
class Motion:
    """One motion from ``began_s`` on; before it the axis stands at its beginning, afterwards at ``end``."""

    began_s: float
    end: float
    phases: tuple[Phase, ...] = ()

    @property
    def ended_s(self) -> float:
        return self.began_s + sum(phase.duration_s for phase in self.phases)

    def at(self, time_s: float) -> tuple[float, float]:
        """Position and velocity."""
        elapsed = time_s - self.began_s
        if self.phases and elapsed <= 0:
            return self.phases[0].position, self.phases[0].velocity
        for phase in self.phases:
            if elapsed < phase.duration_s:
                return phase.at(elapsed)
            elapsed -= phase.duration_s
        return self.end, 0.0


def trapezoid(start: float, end: float, speed: float, acceleration: float, began_s: float) -> Motion:
    """From rest to rest: speeding up, at ``speed``, slowing down; without the middle where the way is too short.

    An infinite acceleration means that there is the middle alone.
    """
    distance, sign = abs(end - start), math.copysign(1.0, end - start)
    if distance == 0:
        return Motion(began_s, end)
    ramp = min(speed**2 / acceleration, distance) / 2  # way of either ramp
    top = math.sqrt(2 * ramp * acceleration) if ramp > 0 else speed
    ramp_s = top / acceleration
    up = Phase(ramp_s, start, 0.0, sign * acceleration) if ramp > 0 else Phase(0.0, start, 0.0)
    middle = Phase((distance - 2 * ramp) / top, start + sign * ramp, sign * top)
    down = Phase(ramp_s, end - sign * ramp, sign * top, -sign * acceleration) if ramp > 0 else Phase(0.0, end, 0.0)
    return Motion(began_s, end, (up, middle, down))


def braking(position: float, velocity: float, acceleration: float, began_s: float) -> Motion:
    """From ``velocity`` to rest."""
    if velocity == 0 or math.isinf(acceleration):
        return Motion(began_s, position)
    sign, duration = math.copysign(1.0, velocity), abs(velocity) / acceleration
    end = position + velocity * duration / 2
    return Motion(began_s, end, (Phase(duration, position, velocity, -sign * acceleration),))
