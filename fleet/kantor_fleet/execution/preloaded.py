"""Imported by the fork server only: warms it up, so that its children start warm."""

from kantor_fleet.execution.preload import warm_up

warm_up()
