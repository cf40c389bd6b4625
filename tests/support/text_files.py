"""Texts of sound files: recipes, captures as they are described, a scene."""

RECIPES = {
    "scene": """scene: {builtin: cornell_box, resolution: 8}
variant: llvm_ad_mono
time_axis: {start_opl: 2.0, bin_width_opl: 0.2, num_bins: 60}
spp: 4
sampler: owen
n: 12
labels: [depth]
device: vl53l8_like
vary:
  red.reflectance.value: {uniform: [0.05, 0.9]}
  small-box.to_world: {compose: [{turn: {axis: [0, 1, 0]}}, {offset: [[-0.2, 0, 0], [0.2, 0, 0]]}]}
  small-box.type: {choice: [cube, sphere]}
""",
    "capture": """hidden: {letter: {shape: rectangle, scale: 0.2, rotate: [[0, 1, 0], 180], translate: [0, 0, 1]}}
wall: {width: 1, height: 1}
scan: {kind: confocal, size: [4, 4]}
variant: llvm_ad_mono
time_axis: {start_opl: 0, bin_width_opl: 0.02, num_bins: 200}
vary: {letter.to_world: {offset: [[-0.1, -0.1, 0], [0.1, 0.1, 0]]}}
""",
}

SETUPS = {
    "own": """hidden:
  ball: {shape: sphere, scale: 0.2, translate: [0.4, 0, 0.8], albedo: 0.7}
wall: {width: 2.0, height: 2.0, albedo: 0.5}
scan: {kind: confocal, size: [4, 4]}
time_axis: {start_opl: 0.1, bin_width_opl: 0.01, num_bins: 300}
spp: 16
bounces: [3]
seed: 0
variant: llvm_ad_mono
""",
    "tal": """name: letter-single
mitsuba_variant: llvm_ad_mono
integrator_nlos_hidden_geometry_sampling: true
sample_count: 10_000
num_bins: 320
bin_width_opl: 0.003
start_opl: 1.95
sensor_width: 8
sensor_height: 6
geometry:
- name: ball
  mesh:
    type: sphere
  displacement_z: 1.0
  rot_degrees_x: 10.0
  material:
    id: copper
    alpha: 0.2
- name: relay_wall
  mesh:
    type: rectangle
  scale_x: 1
  scale_y: 0.5
  material:
    id: white
relay_wall: relay_wall
""",
}

# As the scenes of mitransient 1.x are written: its plugin and parameter names, and an older version number.
SCENE = """<scene version="3.0.0">
    <default name="spp" value="8"/>
    <default name="depth" value="3"/>
    <integrator type="transient_path">
        <integer name="max_depth" value="$depth"/>
        <boolean name="camera_unwarp" value="false"/>
        <string name="temporal_filter" value="box"/>
    </integrator>
    <sensor type="perspective" id="eye">
        <float name="fov" value="20"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="transient_hdr_film">
            <integer name="width" value="4"/> <integer name="height" value="3"/>
            <integer name="temporal_bins" value="24"/>
            <float name="bin_width_opl" value="0.25"/> <float name="start_opl" value="6"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="diffuse" id="grey"><spectrum name="reflectance" value="0.5"/></bsdf>
    <shape type="rectangle" id="wall">
        <transform name="to_world"><scale value="3"/></transform>
        <ref id="grey"/>
    </shape>
    <shape type="cube">
        <transform name="to_world"><scale value="0.3"/><translate x="0.4" z="0.5"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.5, 0.2"/></bsdf>
    </shape>
    <emitter type="point" id="light">
        <point name="position" x="-0.5" y="0.25" z="4"/> <rgb name="intensity" value="10, 10, 10"/>
    </emitter>
</scene>
"""
