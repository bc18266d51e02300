"""Motions of an emulated axis obey its speed and acceleration, and last as long as the driver's own formula says."""

import math

import numpy as np
import pytest

from greenough.instrument.zaber_stage import travel_s
from greenough.twin.wire.motion import Motion, braking, trapezoid

SPEED, ACCELERATION = 5000.0, 20_000.0
WAYS = (1.0, 1249.0, 1250.0, 1251.0, 40_000.0)  # it takes 1250 to get up to speed and down again


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_trapezoid_is_continuous_and_keeps_to_speed_and_acceleration(way, sign):
    motion = trapezoid(300.0, 300.0 + sign * way, SPEED, ACCELERATION, began_s=7.0)
    times = np.linspace(6.9, motion.ended_s + 0.1, 4001)
    position, velocity = np.array([motion.at(t) for t in times]).T
    step = times[1] - times[0]
    assert position[0] == 300.0
    assert position[-1] == pytest.approx(300.0 + sign * way, rel=1e-12)
    assert np.abs(velocity).max() <= SPEED * (1 + 1e-9)
    assert np.all(np.abs(np.diff(velocity)) <= ACCELERATION * step * (1 + 1e-6) + 1e-9)
    assert np.all(np.abs(np.diff(position)) <= SPEED * step * (1 + 1e-6) + 1e-9)
    assert np.all(sign * np.diff(position) >= -1e-9)
    np.testing.assert_allclose(np.diff(position) / step, (velocity[1:] + velocity[:-1]) / 2, atol=ACCELERATION * step)


@pytest.mark.parametrize("way", WAYS)
def test_it_takes_the_time_that_the_driver_expects(way):
    assert trapezoid(0, way, SPEED, ACCELERATION, 0.0).ended_s == pytest.approx(travel_s(way, SPEED, ACCELERATION))
    assert trapezoid(0, way, SPEED, math.inf, 0.0).ended_s == pytest.approx(travel_s(way, SPEED, 0.0))


def test_no_way_is_no_motion():
    assert trapezoid(5.0, 5.0, SPEED, ACCELERATION, 2.0) == Motion(2.0, 5.0)


@pytest.mark.parametrize("velocity", [SPEED, -SPEED, 100.0])
def test_braking_goes_on_by_half_the_square_of_the_speed_over_the_acceleration(velocity):
    motion = braking(0.0, velocity, ACCELERATION, 1.0)
    assert motion.end == pytest.approx(math.copysign(velocity**2 / (2 * ACCELERATION), velocity))
    assert motion.ended_s == pytest.approx(1.0 + abs(velocity) / ACCELERATION)
    assert motion.at(1.0) == (0.0, velocity)
    position, last = motion.at(motion.ended_s - 1e-9)
    assert position == pytest.approx(motion.end)
    assert abs(last) < 1e-3
    assert braking(3.0, velocity, math.inf, 1.0) == Motion(1.0, 3.0)
