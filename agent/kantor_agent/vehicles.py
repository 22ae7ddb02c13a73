"""Vehicles: how a pose moves towards a goal in one step. The planner never knows which one drives.

Every vehicle ends a step within speed * dt of where it began, which world-sim checks. Plain floats
throughout: a step costs about a microsecond.
"""

import math
from collections.abc import Callable
from typing import Protocol

from kantor_protocol.base.machine import Body, Pose
from kantor_protocol.scenario.schema import VehicleOptions as Parameters

_LATER_NS = 1 << 62
"""A time of the last step that is later than any: no time has passed since, as on a clock that was set back."""


class StepTimer:
    """The time from one step of a robot to the next, in which its vehicle drives."""

    def __init__(self, period_ns: int, body: Body) -> None:
        """body: the one that the robot takes over."""
        self._period_ns = period_ns
        # An incarnation that takes over a body on its way does not know when that moved last: it holds for a step.
        self._last_ns = 0 if body.step == 0 else _LATER_NS

    def elapsed_s(self, now_ns: int) -> float:
        """Seconds since the call before: between 0 and a period, whatever the clock says."""
        elapsed_ns = now_ns - self._last_ns
        if not 0 <= elapsed_ns <= self._period_ns:
            elapsed_ns = 0 if elapsed_ns < 0 else self._period_ns
        self._last_ns = now_ns
        return elapsed_ns * 1e-9


class Vehicle(Protocol):
    """Motion under a goal."""

    def drive(self, pose: Pose, x_m: float, y_m: float, dt_s: float, /) -> Pose:
        """The pose after dt_s when heading for (x_m, y_m), world frame."""
        ...


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)


def _clamped(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))


def _stopping(distance_m: float, acceleration_m_s2: float, dt_s: float) -> float:
    """The speed from which braking in steps of dt stops within the distance: v^2 / 2a + v dt / 2, solved for v."""
    half = acceleration_m_s2 * dt_s / 2.0
    return math.sqrt(half * half + 2.0 * acceleration_m_s2 * distance_m) - half


class FirstOrder:
    """x <- x + u_max dt (g - x) / |g - x| (Kabir & Lee, eq. 16), and no further than the goal."""

    def __init__(self, parameters: Parameters) -> None:
        self._speed_m_s = parameters.speed_m_s

    def drive(self, pose: Pose, x_m: float, y_m: float, dt_s: float, /) -> Pose:
        """A straight step."""
        dx, dy = x_m - pose.x_m, y_m - pose.y_m
        distance, step = math.sqrt(dx * dx + dy * dy), self._speed_m_s * dt_s
        if distance == 0.0:
            return Pose(pose.x_m, pose.y_m, pose.heading_rad, 0.0)
        heading = math.atan2(dy, dx)
        if distance <= step:
            return Pose(x_m, y_m, heading, distance / dt_s if dt_s > 0.0 else 0.0)
        share = step / distance
        return Pose(pose.x_m + share * dx, pose.y_m + share * dy, heading, self._speed_m_s)


class SecondOrder:
    """A double integrator: bounded acceleration and speed, in any direction.

    It steers its velocity to the one from which it would just stop at the goal under the bound. Its
    heading is the direction of its velocity.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._speed_m_s = parameters.speed_m_s
        self._acceleration_m_s2 = parameters.acceleration_m_s2

    def drive(self, pose: Pose, x_m: float, y_m: float, dt_s: float, /) -> Pose:
        """Semi-implicit Euler: velocity first, then position."""
        if dt_s <= 0.0:
            return pose
        dx, dy = x_m - pose.x_m, y_m - pose.y_m
        distance = math.hypot(dx, dy)
        braking = _stopping(distance, self._acceleration_m_s2, dt_s)
        wanted = min(self._speed_m_s, braking, distance / dt_s)
        share = wanted / distance if distance > 0.0 else 0.0
        vx = pose.speed_m_s * math.cos(pose.heading_rad)
        vy = pose.speed_m_s * math.sin(pose.heading_rad)
        ax, ay = share * dx - vx, share * dy - vy
        change, bound = math.hypot(ax, ay), self._acceleration_m_s2 * dt_s
        if change > bound:
            ax, ay = ax * bound / change, ay * bound / change
        vx, vy = vx + ax, vy + ay
        speed = math.hypot(vx, vy)
        if speed > self._speed_m_s:
            vx, vy = vx * self._speed_m_s / speed, vy * self._speed_m_s / speed
            speed = self._speed_m_s
        heading = math.atan2(vy, vx) if speed > 0.0 else pose.heading_rad
        return Pose(pose.x_m + vx * dt_s, pose.y_m + vy * dt_s, heading, speed)


class Unicycle:
    """Drives along its heading, turns on the spot or on the way; bounded turn rate and acceleration."""

    def __init__(self, parameters: Parameters) -> None:
        self._speed_m_s = parameters.speed_m_s
        self._acceleration_m_s2 = parameters.acceleration_m_s2
        self._turn_rate_rad_s = parameters.turn_rate_rad_s

    def drive(self, pose: Pose, x_m: float, y_m: float, dt_s: float, /) -> Pose:
        """Turn towards the goal, then drive; slower the further the heading is off the goal."""
        if dt_s <= 0.0:
            return pose
        dx, dy = x_m - pose.x_m, y_m - pose.y_m
        distance = math.hypot(dx, dy)
        error = _wrapped(math.atan2(dy, dx) - pose.heading_rad) if distance > 0.0 else 0.0
        turn = _clamped(error, self._turn_rate_rad_s * dt_s)
        heading = _wrapped(pose.heading_rad + turn)
        braking = _stopping(distance, self._acceleration_m_s2, dt_s)
        wanted = min(self._speed_m_s, braking, distance / dt_s) * max(0.0, math.cos(error - turn))
        # On a circle through the goal the bearing turns at 2 v sin(error) / distance. If that is faster than
        # the vehicle can turn, it would orbit the goal for ever.
        off = 2.0 * abs(math.sin(error - turn))
        if off * wanted > self._turn_rate_rad_s * distance:
            wanted = self._turn_rate_rad_s * distance / off
        bound = self._acceleration_m_s2 * dt_s
        speed = pose.speed_m_s + _clamped(wanted - pose.speed_m_s, bound)
        speed = max(0.0, min(speed, self._speed_m_s))
        return Pose(
            pose.x_m + speed * dt_s * math.cos(heading),
            pose.y_m + speed * dt_s * math.sin(heading),
            heading,
            speed,
        )


class Dubins:
    """Drives at full speed always and turns no tighter than its turn radius, as a fixed-wing aircraft.

    A goal within either turning circle cannot be reached by turning to it, so the vehicle first goes
    straight until it lies outside (the first leg of the shortest path has the same effect).
    """

    def __init__(self, parameters: Parameters) -> None:
        self._speed_m_s = parameters.speed_m_s
        self._radius_m = parameters.turn_radius_m

    def drive(self, pose: Pose, x_m: float, y_m: float, dt_s: float, /) -> Pose:
        """One arc or line of length speed * dt."""
        dx, dy = x_m - pose.x_m, y_m - pose.y_m
        distance, length = math.hypot(dx, dy), self._speed_m_s * dt_s
        ahead = math.cos(pose.heading_rad) * dx + math.sin(pose.heading_rad) * dy
        left = -math.sin(pose.heading_rad) * dx + math.cos(pose.heading_rad) * dy
        turn = 0.0
        # Outside both circles: |goal - centre| >= radius, the centre a radius to the side.
        if distance * distance >= 2.0 * self._radius_m * abs(left) and distance > 0.0:
            turn = _clamped(math.atan2(left, ahead), length / self._radius_m)
        heading = _wrapped(pose.heading_rad + turn)
        half = turn / 2.0
        chord = length if half == 0.0 else length * (math.sin(half) / half)
        middle = pose.heading_rad + half
        return Pose(
            pose.x_m + chord * math.cos(middle),
            pose.y_m + chord * math.sin(middle),
            heading,
            self._speed_m_s,
        )


VEHICLES: dict[str, Callable[[Parameters], Vehicle]] = {
    "first-order": FirstOrder,
    "second-order": SecondOrder,
    "unicycle": Unicycle,
    "dubins": Dubins,
}
"""Makes a vehicle from its options, by name."""
