"""What a scan is evidence of, beam by beam and cell by cell, in plain Python."""

import math
from collections import defaultdict

from kantor_protocol.base.grid import Frame, next_cell
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.occupancy_log import CODES, HIT, PASS, beam_rad
from kantor_protocol.scenario.schema import SensorOptions


def evidence_of(
    frame: Frame, sensor: SensorOptions, codes: list[int], pose: Pose
) -> list[tuple[int, bool]]:
    """The cells that a scan tells of, rising, and whether it is evidence that they are occupied."""
    u, v = frame.uv(pose.x_m, pose.y_m)
    if not (0.0 <= u < frame.columns and 0.0 <= v < frame.rows):
        return []
    reach = sensor.range_m / frame.resolution_m
    tolerance = reach / CODES + min(3.0 * sensor.noise_m / frame.resolution_m, 0.5)
    sums: dict[tuple[int, int], int] = defaultdict(int)
    for beam, code in enumerate(codes):
        view_rad = math.radians(sensor.field_of_view_deg)
        angle_rad = beam_rad(pose.heading_rad, view_rad, len(codes), beam)
        met = (code / CODES * reach, tolerance) if code <= CODES else (reach, -1.0)
        for cell, votes in _beam(frame, u, v, angle_rad, *met):
            sums[cell] += votes
    return sorted(
        (row * frame.columns + column, votes > 0) for (row, column), votes in sums.items()
    )


def _beam(
    frame: Frame, u: float, v: float, angle_rad: float, reach: float, tolerance: float
) -> list[tuple[tuple[int, int], int]]:
    cell = (int(v), int(u))
    passed, entered = [(cell, PASS)], []
    while True:
        *to, share = next_cell(*cell, u, v, math.cos(angle_rad), math.sin(angle_rad))
        cell = (to[0], to[1])
        if share > reach + max(0.0, tolerance):
            return [*passed, *([(entered[0], HIT)] if len(entered) == 1 else [])]
        if not (0 <= cell[0] < frame.rows and 0 <= cell[1] < frame.columns):
            return passed
        if share >= reach - tolerance:
            entered.append(cell)
        else:
            passed.append((cell, PASS))
