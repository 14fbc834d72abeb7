"""Draws a simulated arm of MuJoCo among gaussians. The arm pushes a donut of gaussians,
which is a body of the simulation.

    pip install '.[mujoco]'
    MUJOCO_GL=egl python examples/mujoco_among_splats.py --output arm.png

MUJOCO_GL=osmesa also draws without a GPU and without a display. More assets can be
placed behind the arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro

import v3dg
from v3dg.cameras import Axis
from v3dg.donut import make_donut
from v3dg.pictures import write_picture
from v3dg.rotations import turn_between
from v3dg.simulators.mujoco import SplatRenderer

RADIUS = 0.12  # radius of the donut
MODEL = f"""
<mujoco>
  <option timestep="0.002"/>
  <visual><headlight ambient=".35 .35 .35" diffuse=".3 .3 .3"/></visual>
  <asset>
    <texture name="grid" type="2d" builtin="checker" width="256" height="256"
      rgb1=".42 .45 .48" rgb2=".37 .4 .43"/>
    <material name="floor" texture="grid" texrepeat="6 6" reflectance="0"/>
    <material name="orange" rgba=".9 .42 .1 1" specular=".4"/>
    <material name="steel" rgba=".75 .77 .8 1" specular=".6"/>
    <material name="dark" rgba=".16 .17 .19 1"/>
  </asset>
  <worldbody>
    <light pos="-.6 -1 2" dir=".3 .5 -1" diffuse=".7 .7 .7" castshadow="true"/>
    <camera name="room" pos=".45 -1.3 .6" xyaxes="1 .28 0 -.1 .32 .95" fovy="40"/>
    <geom name="floor" type="plane" size="1.2 1.2 .1" material="floor"/>
    <geom type="cylinder" pos="-.35 0 .06" size=".12 .06" material="dark" contype="0"
      conaffinity="0"/>
    <body name="turret" pos="-.35 0 .12">
      <joint name="yaw" axis="0 0 1" damping="2"/>
      <geom type="cylinder" size=".08 .05" material="steel"/>
      <body name="upper" pos="0 0 .06">
        <joint name="shoulder" axis="0 1 0" damping="2"/>
        <geom type="capsule" fromto="0 0 0 0 0 .34" size=".045" material="orange"/>
        <body name="lower" pos="0 0 .34">
          <joint name="elbow" axis="0 1 0" damping="2"/>
          <geom type="sphere" size=".06" material="dark"/>
          <geom type="capsule" fromto="0 0 0 0 0 .3" size=".035" material="orange"/>
          <body name="hand" pos="0 0 .3">
            <joint name="wrist" axis="0 1 0" damping="1"/>
            <camera name="wrist" pos="-.08 0 0" xyaxes="0 -1 0 -1 0 0" fovy="70"/>
            <geom type="box" pos="0 0 .03" size=".03 .06 .02" material="dark"/>
            <geom type="box" pos="0 .045 .08" size=".02 .012 .045" material="steel"/>
            <geom type="box" pos="0 -.045 .08" size=".02 .012 .045" material="steel"/>
          </body>
        </body>
      </body>
    </body>
    <body name="donut" pos=".28 .0 {0.42 * RADIUS}">
      <freejoint/>
      <geom type="cylinder" size="{RADIUS} {0.37 * RADIUS}" mass=".1" group="3"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="yaw" kp="120"/>
    <position joint="shoulder" kp="300"/>
    <position joint="elbow" kp="200"/>
    <position joint="wrist" kp="20"/>
  </actuator>
</mujoco>
"""
START = (0.7, 1.17, 1.05, 0.9)  # initial angles of the joints in radians
END = (-0.2, 1.17, 1.05, 0.9)


@dataclass
class Config:
    """Draw a simulated arm of MuJoCo among gaussians."""

    output: Path = Path("arm.png")
    """Picture to write, with the view of the room above the view of the wrist."""
    assets: tuple[Path, ...] = ()
    """More assets, which are placed behind the arm."""
    up: Axis = "z"
    """Axis that is up in these assets."""
    scale: float = 0.25
    """Scale of these assets."""
    gaussians: int = 30_000
    """Number of gaussians of the donut."""
    seconds: float = 2.0
    """Duration of the simulation in seconds."""
    size: tuple[int, int] = (960, 540)
    """Width and height of each picture in px."""
    device: str = "cpu"


def make_scene(config: Config) -> v3dg.Scene:
    """Return a scene whose first instance is the donut of the simulation."""
    build = v3dg.BuildConfig(steps=0)
    donut = v3dg.build_bundle(make_donut(config.gaussians), config=build, progress=False)
    scene = v3dg.Scene()
    scene.add(donut, scales=RADIUS)
    scene.add(donut, [[-0.05, 0.55, 0.05], [0.62, 0.45, 0.05]], scales=[1.2 * RADIUS, RADIUS])
    for number, path in enumerate(config.assets):
        bundle = v3dg.build_bundle(v3dg.read_asset(path), config=build, progress=False)
        place = (-0.5 + 0.8 * number, 0.85, 0.0)
        scene.add(bundle, place, turn_between(config.up, "z"), config.scale)
    return scene


def simulate(seconds: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the model and its state after the arm has swept over the floor."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    data.qpos[:4] = START
    mujoco.mj_forward(model, data)
    for share in np.linspace(0, 1, round(seconds / model.opt.timestep)):
        data.ctrl[:] = (1 - share) * np.array(START) + share * np.array(END)
        mujoco.mj_step(model, data)
    return model, data


def main(config: Config) -> v3dg.RenderedImage:
    """Simulate, and draw the last state; return the picture of the room."""
    model, data = simulate(config.seconds)
    width, height = config.size
    with SplatRenderer(
        model, make_scene(config), width=width, height=height, device=config.device
    ) as renderer:
        renderer.attachments.attach(0, "donut")
        pictures = [
            renderer.render(
                data, camera, background=(0.75, 0.83, 0.9), channels=("depth", "instance")
            )
            for camera in ("room", "wrist")
        ]
    write_picture(config.output, np.concatenate([picture.color for picture in pictures]))
    return pictures[0]


if __name__ == "__main__":
    main(tyro.cli(Config))
