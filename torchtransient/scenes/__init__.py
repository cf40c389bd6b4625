"""Scene dictionaries in metres. They need no Mitsuba variant: transforms are (4, 4) arrays, plugins are named by
string."""

from torchtransient.scenes.bottle import milk_bottle as milk_bottle
from torchtransient.scenes.cavities import furnace as furnace
from torchtransient.scenes.cavities import integrating_sphere as integrating_sphere
from torchtransient.scenes.cavities import parallel_plates as parallel_plates
from torchtransient.scenes.cornell import cornell_box as cornell_box
from torchtransient.scenes.meshes import triangle_mesh as triangle_mesh
from torchtransient.scenes.nlos import bounds as bounds
from torchtransient.scenes.nlos import nlos_corner as nlos_corner
from torchtransient.scenes.nlos import nlos_letter as nlos_letter
from torchtransient.scenes.nlos import nlos_mannequin as nlos_mannequin
from torchtransient.scenes.nlos import nlos_plates as nlos_plates
from torchtransient.scenes.nlos import nlos_room as nlos_room
from torchtransient.scenes.nlos import nlos_z as nlos_z
from torchtransient.scenes.nlos import relay_wall as relay_wall
from torchtransient.scenes.transforms import look_at as look_at
from torchtransient.scenes.transforms import rotate as rotate
from torchtransient.scenes.transforms import scale as scale
from torchtransient.scenes.transforms import translate as translate
from torchtransient.scenes.walls import etalon_slab as etalon_slab
from torchtransient.scenes.walls import glass_slab_before_wall as glass_slab_before_wall
from torchtransient.scenes.walls import light_over_plane as light_over_plane
from torchtransient.scenes.walls import moving_wall as moving_wall
