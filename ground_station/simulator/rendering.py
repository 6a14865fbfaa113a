"""Renders surfaces with MuJoCo, headless: an ideal pinhole image and its depth, for any pose.

Light is baked into the textures beforehand (`lighting`), so MuJoCo draws them as they are: one pass
a picture, and radiance beyond eight bits stays ours to decide.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

os.environ["MUJOCO_GL"] = "egl"  # headless; read when mujoco is first imported

import mujoco
import numpy as np

from ground_station.arrays import F32, F64, U8
from ground_station.simulator.people import Walker
from ground_station.simulator.scene import SimulatorError, Surface

_ATLAS_TEXELS = 2048
_GUTTER_TEXELS = 8  # repeated border around each texture, so that mipmaps don't mix neighbours
_NEAR_M, _FAR_M = 0.05, 120.0


@dataclass(frozen=True)
class Pinhole:
    """An ideal camera with square pixels and its principal point at the image's centre."""

    width_px: int
    height_px: int
    focal_px: float

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point; the centre of the top-left pixel is (0, 0)."""
        return (self.width_px - 1) / 2, (self.height_px - 1) / 2


@dataclass(frozen=True)
class _Slot:
    atlas: int
    x: int
    y: int


def _pack(sizes: Sequence[tuple[int, int]]) -> tuple[list[_Slot], int]:
    """Shelf packing of (width, height) into square atlases; tallest first."""
    slots: dict[int, _Slot] = {}
    atlas = x = y = shelf = 0
    pad = 2 * _GUTTER_TEXELS
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], i)):
        width, height = sizes[index][0] + pad, sizes[index][1] + pad
        if max(width, height) > _ATLAS_TEXELS:
            limit = _ATLAS_TEXELS - pad
            raise SimulatorError(f"a texture of {sizes[index]} texels; at most {limit} fit")
        if x + width > _ATLAS_TEXELS:
            x, y, shelf = 0, y + shelf, 0
        if y + height > _ATLAS_TEXELS:
            atlas, x, y, shelf = atlas + 1, 0, 0, 0
        slots[index] = _Slot(atlas, x + _GUTTER_TEXELS, y + _GUTTER_TEXELS)
        x, shelf = x + width, max(shelf, height)
    return [slots[i] for i in range(len(sizes))], atlas + 1


def _add_walker(spec: Any, number: int, walker: Walker) -> None:
    """A body that is moved from outside, of boxes and a ball, metres above the floor."""
    body = spec.worldbody.add_body(name=f"walker{number}", mocap=True)
    ball, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
    for part, colours, shape, size, height_m in (
        ("legs", walker.legs[None, None], box, [0.13, 0.16, 0.43], 0.43),
        ("coat", walker.coat, box, [0.15, 0.24, 0.34], 1.18),
        ("head", walker.skin[None, None], ball, [0.12, 0, 0], 1.64),
    ):
        name = f"walker{number}-{part}"
        side = np.ascontiguousarray(np.broadcast_to(colours, (64, 64, 3)))
        texture = spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_CUBE, nchannel=3, width=64, height=6 * 64
        )
        texture.data = 6 * side.tobytes()
        material = spec.add_material(name=name, emission=1.0, specular=0.0)
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
        body.add_geom(
            type=shape, size=size, pos=[0, 0, height_m], material=name, contype=0, conaffinity=0
        )


def _model(
    surfaces: Sequence[Surface],
    textures: Sequence[U8],
    buffer_px: tuple[int, int],
    samples: int,
    walkers: Sequence[Walker],
) -> Any:
    """The compiled MuJoCo model: one mesh and one texture atlas for each group of surfaces."""
    slots, count = _pack([(t.shape[1], t.shape[0]) for t in textures])
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = buffer_px
    spec.visual.quality.offsamples = samples
    spec.visual.headlight.active = 0
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = _NEAR_M, _FAR_M
    g = _GUTTER_TEXELS
    for atlas in range(count):
        image = np.zeros((_ATLAS_TEXELS, _ATLAS_TEXELS, 3), np.uint8)
        vertices: list[list[float]] = []
        coordinates: list[list[float]] = []
        faces: list[list[int]] = []
        for surface, texture, slot in zip(surfaces, textures, slots, strict=True):
            if slot.atlas != atlas:
                continue
            h, w = texture.shape[:2]
            padded = np.pad(texture, ((g, g), (g, g), (0, 0)), mode="edge")
            image[slot.y - g : slot.y + h + g, slot.x - g : slot.x + w + g] = padded
            left, right = slot.x / _ATLAS_TEXELS, (slot.x + w) / _ATLAS_TEXELS
            top, bottom = slot.y / _ATLAS_TEXELS, (slot.y + h) / _ATLAS_TEXELS
            n = len(vertices)
            vertices += surface.corners().tolist()
            coordinates += [[left, bottom], [right, bottom], [right, top], [left, top]]
            faces += [[n, n + 1, n + 2], [n, n + 2, n + 3]]
        texture_asset = spec.add_texture(
            name=f"atlas{atlas}", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3,
            width=_ATLAS_TEXELS, height=_ATLAS_TEXELS,
        )  # fmt: skip
        texture_asset.data = image.tobytes()
        material = spec.add_material(name=f"atlas{atlas}", emission=1.0, specular=0.0)
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = f"atlas{atlas}"
        spec.add_mesh(
            name=f"atlas{atlas}",
            uservert=np.asarray(vertices, np.float32).ravel(),
            usertexcoord=np.asarray(coordinates, np.float32).ravel(),
            userface=np.asarray(faces, np.int32).ravel(),
            userfacetexcoord=np.asarray(faces, np.int32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"atlas{atlas}", material=f"atlas{atlas}",
            contype=0, conaffinity=0,
        )  # fmt: skip
    for number, walker in enumerate(walkers):
        _add_walker(spec, number, walker)
    try:
        return spec.compile()
    except ValueError as error:
        raise SimulatorError(f"MuJoCo refuses the scene: {str(error).splitlines()[0]}") from None


class SceneRenderer:
    """Surfaces on the graphics side; a context manager. `textures` are 8-bit RGB, one a surface.

    The `walkers` stand where they are at 0 s, or wherever `at` was told last.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        textures: Sequence[U8],
        buffer_px: tuple[int, int],
        *,
        samples: int = 4,
        cull_backs: bool = True,
        walkers: Sequence[Walker] = (),
    ) -> None:
        self._width, self._height = buffer_px
        self._model = _model(surfaces, textures, buffer_px, samples, walkers)
        self._walkers, self._data = walkers, mujoco.MjData(self._model)
        try:
            self._renderer = mujoco.Renderer(self._model, self._height, self._width)
        except Exception as error:  # the bindings raise whatever the EGL loader does
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise SimulatorError(f"no headless rendering (EGL, Mesa): {line}") from None
        self._place(0.0)
        scene = self._renderer.scene
        scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = int(cull_backs)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 0

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the graphics memory."""
        self._renderer.close()

    def at(self, time_s: float) -> None:
        """Whoever walks is where they are at that time from now on."""
        if self._walkers:
            self._place(time_s)

    def _place(self, time_s: float) -> None:
        for number, walker in enumerate(self._walkers):
            x, y, heading = walker.place(time_s)
            self._data.mocap_pos[number] = x, y, 0.0
            self._data.mocap_quat[number] = np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data)

    def _aim(self, wTc: F64, half_height: float, half_width: float, ortho_depth_m: float) -> None:
        for camera in self._renderer.scene.camera:  # left and right eye: the same
            camera.pos[:] = wTc[:3, 3]
            camera.forward[:] = wTc[:3, 2]
            camera.up[:] = -wTc[:3, 1]
            camera.orthographic = int(ortho_depth_m > 0)
            camera.frustum_center, camera.frustum_width = 0.0, half_width
            camera.frustum_bottom, camera.frustum_top = -half_height, half_height
            camera.frustum_near = _NEAR_M
            camera.frustum_far = ortho_depth_m or _FAR_M

    def image_and_depth(self, wTc: F64, pinhole: Pinhole) -> tuple[U8, F32]:
        """The picture (H, W, 3) RGB and z-depth (H, W) in metres; infinity where nothing is."""
        self._aim_pinhole(wTc, pinhole)
        return self._renderer.render(), self._depth()

    def depth(self, wTc: F64, pinhole: Pinhole) -> F32:
        """Only the z-depth (H, W), metres."""
        self._aim_pinhole(wTc, pinhole)
        return self._depth()

    def _aim_pinhole(self, wTc: F64, pinhole: Pinhole) -> None:
        if (pinhole.width_px, pinhole.height_px) != (self._width, self._height):
            raise SimulatorError(
                f"a picture of {pinhole.width_px}x{pinhole.height_px} from a buffer of"
                f" {self._width}x{self._height}"
            )
        half_height = 0.5 * pinhole.height_px / pinhole.focal_px * _NEAR_M
        half_width = 0.5 * pinhole.width_px / pinhole.focal_px * _NEAR_M
        self._aim(wTc, half_height, half_width, 0.0)

    def _depth(self) -> F32:
        self._renderer.enable_depth_rendering()
        z = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return np.where(z >= 0.99 * _FAR_M, np.float32(np.inf), z)

    def orthographic_depth(self, wTc: F64, half_size_m: float) -> F32:
        """Distance (H, W) along parallel rays, metres: what a directional light sees."""
        self._aim(wTc, half_size_m, half_size_m * self._width / self._height, _FAR_M)
        return self._depth()
