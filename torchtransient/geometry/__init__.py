"""Pinhole cameras, distances and normals between Mitsuba's frames and kornia's. Torch only, never Mitsuba.

Two frames at one pinhole, both right-handed, both looking along +z, half a turn about z apart:

- Mitsuba's camera: +x to the *left* of the image, +y up. `to_world` (4, 4) takes it to the world.
- kornia's (and OpenCV's) camera: +x to the right, +y down. Intrinsics (3, 3) and `extrinsics`, world to camera, are
  its.

Pixels count as kornia counts them: the centre of the first pixel is (0, 0), u runs to the right and v downwards.
"""

from torchtransient.geometry.distances import distance_from_opl as distance_from_opl
from torchtransient.geometry.distances import distance_from_z_depth as distance_from_z_depth
from torchtransient.geometry.distances import normals_from_distance as normals_from_distance
from torchtransient.geometry.distances import opl_from_distance as opl_from_distance
from torchtransient.geometry.distances import points_from_distance as points_from_distance
from torchtransient.geometry.distances import ray_directions as ray_directions
from torchtransient.geometry.distances import z_depth_from_distance as z_depth_from_distance
from torchtransient.geometry.pinhole import camera_to_world as camera_to_world
from torchtransient.geometry.pinhole import extrinsics as extrinsics
from torchtransient.geometry.pinhole import intrinsics as intrinsics
from torchtransient.geometry.pinhole import pinhole_camera as pinhole_camera
from torchtransient.geometry.pinhole import to_world_from_extrinsics as to_world_from_extrinsics
