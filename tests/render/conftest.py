"""Fixtures of this folder."""

from render_rooms import room as room
from render_rooms import room_scene as room_scene
from render_rooms import weights as weights
