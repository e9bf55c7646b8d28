"""Arrays, and foreign files of cameras written out by hand, for the tests of the formats."""

from __future__ import annotations

import numpy as np

from capture.arrays import Floats
from capture.camera import Camera, CameraArray
from capture.pose import Pose

CLOUD = np.random.default_rng(11).uniform(-90.0, 90.0, (80, 3))
"""Points (80, 3) about the world's origin, mm."""


def random_array(seed: int, count: int = 5, k3: bool = True) -> CameraArray:
    """Cameras all about the origin with full lenses; the first stands nowhere special."""
    rng = np.random.default_rng(seed)
    cameras = []
    for number in range(count):
        turn = Pose.from_rotation_vector(rng.uniform(-3.0, 3.0, 3), np.zeros(3)).rotation
        distortion = rng.uniform(-1, 1, 5) * [0.2, 0.1, 2e-3, 2e-3, 0.05]
        distortion[4] *= k3
        width, height = rng.integers(400, 5000, 2).tolist()
        cameras.append(
            Camera(
                name=f"c{rng.integers(100, 999)}_{number}", width=width, height=height,
                fx=rng.uniform(500, 5000), fy=rng.uniform(500, 5000),
                cx=width / 2 + rng.normal(0, 20), cy=height / 2 + rng.normal(0, 20),
                distortion=distortion,
                camera_from_world=Pose(turn, [*rng.normal(0, 50, 2), rng.uniform(500, 1200)]),
            )
        )  # fmt: skip
    return CameraArray(tuple(cameras))


def changed(camera: Camera, **what: object) -> Camera:
    """The camera with some of its fields replaced."""
    fields = {name: getattr(camera, name) for name in camera.__dataclass_fields__}
    return Camera(**(fields | what))  # type: ignore[arg-type]


def assert_same(found: CameraArray, wanted: CameraArray, relative: float = 1e-9) -> None:
    """Every number of every camera agrees, cameras taken by name."""
    assert sorted(found.names) == sorted(wanted.names)
    for one in wanted:
        other = found.by_name(one.name)
        assert (other.width, other.height) == (one.width, one.height)
        for a, b in (
            (other.matrix, one.matrix),
            (other.distortion, one.distortion),
            (other.camera_from_world.rotation, one.camera_from_world.rotation),
            (other.camera_from_world.translation, one.camera_from_world.translation),
        ):
            scale = max(float(np.abs(b).max()), 1e-3)
            np.testing.assert_allclose(a, b, rtol=relative, atol=relative * scale)


def assert_projects_alike(found: CameraArray, wanted: CameraArray, points: Floats) -> None:
    """Every point lands within 1e-6 px of where it did."""
    for one in wanted:
        np.testing.assert_allclose(
            found.by_name(one.name).project(points), one.project(points), rtol=0, atol=1e-6
        )


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="2">
      <sensor id="0" label="wide" type="frame">
        <resolution width="1000" height="800"/>
        <property name="pixel_width" value="0.005"/>
        <calibration type="frame" class="initial">
          <resolution width="1000" height="800"/><f>1111</f>
        </calibration>
        <calibration type="frame" class="adjusted">
          <resolution width="1000" height="800"/>
          <f>1500.5</f><cx>7.25</cx><cy>-3.5</cy><b1>2.5</b1>
          <k1>-0.08</k1><k2>0.03</k2><k3>-0.004</k3><p1>0.0007</p1><p2>-0.0011</p2>
        </calibration>
      </sensor>
      <sensor id="7" label="tall" type="frame">
        <resolution width="600" height="900"/>
        <calibration type="frame" class="adjusted">
          <resolution width="600" height="900"/>
          <f>1200</f><k1>0.05</k1>
        </calibration>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0">
      <component id="0" label="Component 1">
        <transform>
          <rotation locked="true">0 -1 0 1 0 0 0 0 1</rotation>
          <translation locked="true">0.2 0.1 -0.3</translation>
          <scale locked="true">0.5</scale>
        </transform>
      </component>
    </components>
    <cameras next_id="9" next_group_id="1">
      <camera id="0" sensor_id="0" component_id="0" label="left">
        <transform>1 0 0 0.25 0 -1 0 0.5 0 0 -1 3 0 0 0 1</transform>
        <orientation>1</orientation>
      </camera>
      <group id="0" label="Group 1" type="folder">
        <camera id="3" sensor_id="7" component_id="0" label="right.JPG">
          <transform>0.8 0 -0.6 1.5 0 -1 0 0.1 -0.6 0 -0.8 2.5 0 0 0 1</transform>
        </camera>
      </group>
      <camera id="4" sensor_id="7" label="spare" enabled="false"/>
    </cameras>
  </chunk>
</document>
"""
"""Two cameras of a chunk turned a quarter about Z, halved and moved; one that is switched off."""

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1e-5]
  distortion_model: radtan
  intrinsics: [460.5, 459.25, 370.0, 250.5]
  resolution: [752, 480]
  rostopic: /camera/left
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 0.0, 1.0, 0.02]
  - [0.0, -1.0, 0.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_model: none
  distortion_coeffs: []
  intrinsics: [455, 454, 376, 240]
  resolution: [752, 480]
cam2:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, 0.0]
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.5]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [500.0, 500.0, 320.0, 240.0]
  resolution: [640, 480]
"""
"""A chain of three: the second a tenth of a metre beside the first, turned a quarter about X."""

OPENCV = """%YAML:1.0
---
rvecs: !!opencv-matrix
   rows: 2
   cols: 1
   dt: "3d"
   data: [ 0., 0., 0., 0., 1.5707963267948966, 0. ]
distortions: !!opencv-matrix
   rows: 10
   cols: 1
   dt: d
   data: [ -1.0e-01, 2.0e-02, 1.0e-03, -2.0e-03, 5.0e-03, 0., 0., 0., 0., 0. ]
Ks: !!opencv-nd-matrix
   sizes: [ 2, 3, 3 ]
   dt: d
   data: [ 800., 0., 319.5, 0., 810., 239.5, 0., 0., 1., 700., 0., 300., 0., 701.,
       200., 0., 0., 1. ]
Ts: !!opencv-matrix
   rows: 2
   cols: 1
   dt: "3d"
   data: [ 0., 0., 0., -0.5, 0.25, 1. ]
is_fisheye: !!opencv-matrix
   rows: 2
   cols: 1
   dt: i
   data: [ 0, 0 ]
image_sizes: !!opencv-matrix
   rows: 2
   cols: 2
   dt: i
   data: [ 640, 480, 600, 400 ]
cam_ids: "front,side"
"""
"""Two cameras as OpenCV's multi-view sample stores them, in metres."""

OPENCV_ONE = """<?xml version="1.0"?>
<opencv_storage>
<image_width>640</image_width>
<image_height>480</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data> 600. 0. 320. 0. 610. 240. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>5</rows><cols>1</cols><dt>d</dt>
  <data> 0.1 -0.2 0.003 0.004 0.05</data></distortion_coefficients>
</opencv_storage>
"""
"""One camera as OpenCV's calibration sample stores it."""
