"""Light, computed once for a scene that does not move and written into its textures.

Sun and sky are seen through depth maps from their directions, as in shadow mapping (Williams
1978), the sky from many directions over the hemisphere; lamps through depth maps from where they
hang. What bounces is diffused through the hall's free space on a coarse grid and scaled to the
energy balance of an integrating sphere. Irradiances are relative: the noon sky is 1.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from ground_station.arrays import F32, F64, I64, U8
from ground_station.simulator import scenes
from ground_station.simulator.building import REFLECTION
from ground_station.simulator.rendering import Pinhole, SceneRenderer
from ground_station.simulator.scene import Scene, SimulatorError, Surface
from ground_station.simulator.textures import SURFACES, TextureBank

_GRID_M = 0.07  # spacing of the light samples on a surface, at least four texels
_SKY_DIRECTIONS = 128
_MAP_PX, _SUN_MAP_PX = 512, 4096
_VOXEL_M = 0.4
_SUN_RADIUS_M = 0.025  # half a penumbra some six metres behind an edge (the sun's disc: 0.53°)
_ALBEDO = 0.50  # mean of the hall's surfaces


@dataclass(frozen=True)
class Light:
    """One state of the sky. Colours are linear RGB with a mean near 1.

    `sun_azimuth_deg` counts from x (east) to y (north); levels are relative irradiances.
    """

    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun_level: float
    sun_rgb: tuple[float, float, float]
    sky_level: float
    sky_rgb: tuple[float, float, float]
    lamp_level: float
    lamp_rgb: tuple[float, float, float] = (1.25, 1.0, 0.68)  # about 3000 K

    @property
    def to_sun(self) -> F64:
        """The unit vector to the sun, world axes."""
        a, e = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


LIGHTS: dict[str, Light] = {
    "noon": Light(-75, 58, 3.2, (1.05, 1.0, 0.92), 1.0, (0.90, 1.0, 1.12), 0.0),
    "cloudy": Light(-75, 40, 0.0, (1.0, 1.0, 1.0), 0.75, (0.97, 1.0, 1.05), 0.0),
    "evening": Light(-128, 24, 2.6, (1.30, 0.96, 0.62), 0.35, (0.90, 1.0, 1.15), 0.05),
    "sunset": Light(-142, 7, 0.9, (1.60, 0.88, 0.42), 0.09, (0.88, 0.97, 1.22), 0.16),
}


def light_named(name: str) -> Light:
    """One of `LIGHTS`, or that of an hour of a day, as `17h`; raises `SimulatorError`."""
    if name in LIGHTS:
        return LIGHTS[name]
    hour = name.removesuffix("h")
    if hour == name or not hour.isdecimal() or int(hour) > 23:
        known = ", ".join(LIGHTS)
        raise SimulatorError(f"light '{name:.40}' is unknown; there are: {known}, 0h to 23h")
    return _at_hour(int(hour))


def _at_hour(hour: float) -> Light:
    """A clear day in April at 40° north, by the sun's time; lamps are lit while it is dim.

    The sun comes through the air mass of Kasten and Young (1989) as Meinel and Meinel (1976) have
    it; what it loses of each colour, and what the sky gives, lies between `noon` and `sunset`.
    """
    turn, north, tilt = np.radians([15 * (hour - 12), 40.0, 10.0])
    up = np.sin(north) * np.sin(tilt) + np.cos(north) * np.cos(tilt) * np.cos(turn)
    south = np.sin(north) * np.cos(tilt) * np.cos(turn) - np.cos(north) * np.sin(tilt)
    elevation_deg = float(np.degrees(np.arcsin(up)))
    azimuth_deg = float(np.degrees(np.arctan2(-south, -np.cos(tilt) * np.sin(turn))))
    noon, sunset = LIGHTS["noon"], LIGHTS["sunset"]

    def through(elevation_deg: float) -> float:
        """The power of the air mass by which light is lost."""
        mass = 1 / (np.sin(np.radians(elevation_deg)) + 0.50572 * (elevation_deg + 6.08) ** -1.6364)
        return float(mass**0.678)

    least, most = through(noon.sun_elevation_deg), through(sunset.sun_elevation_deg)
    lost = through(max(elevation_deg, 0.0))
    share = (lost - least) / (most - least)
    red, green, blue = (
        a * (b / a) ** share for a, b in zip(noon.sun_rgb, sunset.sun_rgb, strict=True)
    )
    sky = max(up / np.sin(np.radians(noon.sun_elevation_deg)), 0.0) ** 1.2
    return Light(
        sun_azimuth_deg=azimuth_deg,
        sun_elevation_deg=elevation_deg,
        sun_level=noon.sun_level * 0.7 ** (lost - least) if elevation_deg > 0 else 0.0,
        sun_rgb=(red, green, blue),
        sky_level=float(noon.sky_level * sky),
        sky_rgb=noon.sky_rgb,
        lamp_level=sunset.lamp_level if sky < _DIM else 0.0,
    )


_DIM = 0.35
"""Below this light of the sky, over that of noon, lamps are lit: that of `evening`."""


def looking(direction: F64, centre_m: npt.ArrayLike, distance_m: float) -> F64:
    """A pose `wTc` that looks along -`direction` at `centre_m` from `distance_m` away."""
    z = -direction / np.linalg.norm(direction)
    helper = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    x = np.cross(z, helper)
    x /= np.linalg.norm(x)
    wTc = np.eye(4)
    wTc[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    wTc[:3, 3] = np.asarray(centre_m) - z * distance_m
    return wTc


def _hemisphere(count: int) -> F64:
    """Directions evenly over the upper hemisphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, azimuth = k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)


def _seen_orthographic(
    depth: F32, wTc: F64, half_m: float, points: F32, shift_m: tuple[float, float]
) -> F32:
    """1 where a point is the first along the parallel rays of a depth map, else 0."""
    n = depth.shape[0]
    local = (points - wTc[:3, 3].astype(np.float32)) @ wTc[:3, :3].astype(np.float32)
    u = ((local[:, 0] + shift_m[0]) / half_m + 1) * (n / 2) - 0.5
    v = ((local[:, 1] + shift_m[1]) / half_m + 1) * (n / 2) - 0.5
    first = _look_up(depth, u, v)
    slope = 2 * half_m / n
    return np.asarray(local[:, 2] < first + 0.02 + slope, np.float32)


def _look_up(depth: F32, u: npt.NDArray[Any], v: npt.NDArray[Any]) -> F32:
    columns = 4096  # cv2.remap takes pictures, not lists
    rows = -(-len(u) // columns)
    grid = np.full((2, rows * columns), -1, np.float32)
    grid[0, : len(u)], grid[1, : len(u)] = u, v
    maps = grid.reshape(2, rows, columns)
    out = cv2.remap(
        depth, maps[0], maps[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("inf"),
    )  # fmt: skip
    return np.asarray(out, np.float32).ravel()[: len(u)]


def _indirect(scene: Scene, points: F32, normals: F32, area: F32, flux: F32) -> F32:
    """Bounced irradiance (M, 3) from the flux that leaves each sample after its first bounce."""
    shape = tuple(int(np.ceil(s / _VOXEL_M)) + 4 for s in scene.size_m)
    limit = np.array(shape) - 1

    def cells(offset_m: float) -> tuple[I64, ...]:
        index = np.floor((points + offset_m * normals) / _VOXEL_M).astype(np.int64) + 2
        return tuple(np.clip(index, 0, limit).T)

    solid = np.zeros(shape, np.float32)
    np.add.at(solid, cells(-0.02), area)
    wall = np.clip(solid / (0.5 * _VOXEL_M**2), 0, 1)
    source = np.zeros((*shape, 3), np.float32)
    np.add.at(source, cells(0.5 * _VOXEL_M), flux)
    open_ = (1 - 0.95 * wall)[..., None]
    field = source.copy()
    for _ in range(140):  # Jacobi steps; walls swallow what they don't reflect
        total = sum(np.roll(field, s, axis=a) for a in range(3) for s in (-1, 1))
        field = (0.985 * total / 6) * open_ + source
    field = ndimage.gaussian_filter(field, (0.8, 0.8, 0.8, 0))
    at = (((points + 0.35 * normals) / _VOXEL_M) + 1.5).T
    bounced = np.stack(
        [ndimage.map_coordinates(field[..., c], at, order=1, mode="nearest") for c in range(3)],
        axis=1,
    ).astype(np.float32)
    # Corners and the ground under furniture see less of the hall.
    crowd = ndimage.gaussian_filter(wall, 1.0)
    near = ndimage.map_coordinates(crowd, (((points + 0.3 * normals) / _VOXEL_M) + 1.5).T, order=1)
    bounced *= np.clip(1.35 - 1.6 * near, 0.3, 1.0)[:, None]
    mean_flux = flux.sum(axis=0) / area.sum()
    level = np.maximum((bounced * area[:, None]).sum(axis=0) / area.sum(), 1e-9)
    # Half diffused, half even: light crosses the hall more directly than it diffuses.
    target = mean_flux / (1 - _ALBEDO)
    even = 0.35 * target * (near < 0.9)[:, None]
    return np.asarray(0.65 * bounced * (target / level) + even, np.float32)


def irradiance(scene: Scene, light: Light) -> list[F32]:
    """Irradiance on each surface as a grid (rows, columns, 3); none (empty) outside."""
    inside = [s for s in scene.surfaces if not s.outside]
    grids, points, normals, area = [], [], [], []
    for s in inside:
        columns, rows = (
            max(2, math.ceil(length / max(_GRID_M, 4 / s.texels_per_m))) for length in s.size_m
        )
        grids.append((rows, columns))
        points.append(s.points(columns, rows).reshape(-1, 3))
        normals.append(np.broadcast_to(s.normal, (rows * columns, 3)))
        area.append(np.full(rows * columns, np.prod(s.size_m) / (rows * columns)))
    n = np.concatenate(normals).astype(np.float32)
    p = np.concatenate(points).astype(np.float32) + np.float32(0.02) * n
    a = np.concatenate(area).astype(np.float32)
    direct = np.zeros_like(p)
    blank = [np.zeros((4, 4, 3), np.uint8)] * len(inside)
    half_m = 0.5 * float(np.linalg.norm(scene.size_m)) + 0.5
    with SceneRenderer(inside, blank, (_MAP_PX, _MAP_PX), samples=0, cull_backs=False) as maps:
        solid_angle = 2 * np.pi / _SKY_DIRECTIONS
        rgb = np.asarray(light.sky_rgb, np.float32) * (light.sky_level * solid_angle / np.pi)
        for direction in _hemisphere(_SKY_DIRECTIONS):
            wTc = looking(direction, scene.centre_m, 40.0)
            depth = maps.orthographic_depth(wTc, half_m)
            cosine = np.maximum(n @ direction.astype(np.float32), 0)
            seen = _seen_orthographic(depth, wTc, half_m, p, (0.0, 0.0))
            direct += (cosine * seen)[:, None] * rgb
        if light.lamp_level > 0:
            direct += _lamps(scene, light, maps, p, n)
    if light.sun_level > 0:
        direct += _sun(scene, light, inside, half_m, p, n)
    direct += _indirect(scene, p, n, a, direct * (_ALBEDO * a)[:, None])
    pieces = np.split(direct, np.cumsum([r * c for r, c in grids])[:-1])
    by_surface = iter(piece.reshape(r, c, 3) for piece, (r, c) in zip(pieces, grids, strict=True))
    empty = np.empty((0, 0, 3), np.float32)
    return [empty if s.outside else next(by_surface) for s in scene.surfaces]


def _sun(
    scene: Scene, light: Light, inside: Sequence[Surface], half_m: float, p: F32, n: F32
) -> F32:
    blank = [np.zeros((4, 4, 3), np.uint8)] * len(inside)
    size = (_SUN_MAP_PX, _SUN_MAP_PX)
    with SceneRenderer(inside, blank, size, samples=0, cull_backs=False) as fine:
        wTc = looking(light.to_sun, scene.centre_m, 40.0)
        depth = fine.orthographic_depth(wTc, half_m)
    cosine = np.maximum(n @ light.to_sun.astype(np.float32), 0)
    seen = np.zeros(len(p), np.float32)
    angles = 2 * np.pi * np.arange(6) / 6
    for k, angle in enumerate(angles):
        r = _SUN_RADIUS_M * (0.5 if k % 2 else 1.0)
        shift = (r * float(np.cos(angle)), r * float(np.sin(angle)))
        seen += _seen_orthographic(depth, wTc, half_m, p, shift) / len(angles)
    rgb = np.asarray(light.sun_rgb, np.float32) * np.float32(light.sun_level)
    return (cosine * seen)[:, None] * rgb


def _lamps(scene: Scene, light: Light, maps: SceneRenderer, p: F32, n: F32) -> F32:
    result = np.zeros_like(p)
    pinhole = Pinhole(_MAP_PX, _MAP_PX, 0.5 * _MAP_PX / 2.2)  # 131° wide, straight down
    rgb = np.asarray(light.lamp_rgb, np.float32) * np.float32(light.lamp_level)
    for position_m in scene.lamps:
        wTc = looking(np.array([0.0, 0.0, 1.0]), position_m, 0.0)
        depth = maps.depth(wTc, pinhole)
        local = (p - wTc[:3, 3].astype(np.float32)) @ wTc[:3, :3].astype(np.float32)
        z = np.maximum(local[:, 2], 1e-3)
        cx, cy = pinhole.centre_px
        u = pinhole.focal_px * local[:, 0] / z + cx
        v = pinhole.focal_px * local[:, 1] / z + cy
        within = (u > 0) & (u < _MAP_PX - 1) & (v > 0) & (v < _MAP_PX - 1) & (local[:, 2] > 0.02)
        seen = within & (z < _look_up(depth, u, v) * 1.01 + 0.03)
        d2 = np.maximum((local**2).sum(axis=1), 0.25)
        to_lamp = -local @ wTc[:3, :3].T.astype(np.float32) / np.sqrt(d2)[:, None]
        cosine = np.maximum((to_lamp * n).sum(axis=1), 0)
        strength = 12.0 * seen * cosine * (z / np.sqrt(d2)) / d2
        result += strength[:, None] * rgb
    return result


@dataclass(frozen=True)
class LitTextures:
    """Radiance as 8-bit pictures, one a surface: radiance = `white` · (code / 255)²."""

    textures: list[U8]
    white: float

    def decoder(self) -> F32:
        """The 256 radiances of the codes."""
        return ((np.arange(256) / 255.0) ** 2 * self.white).astype(np.float32)


@functools.lru_cache(maxsize=1)
def lit_scene(scene_name: str, texels_per_m: float, light_name: str) -> tuple[Scene, LitTextures]:
    """A scene and its lit textures by name; the last is kept, since flights come in series."""
    scene = scenes.build(scene_name, texels_per_m)
    return scene, lit_textures(scene, light_named(light_name))


def lit_textures(scene: Scene, light: Light) -> LitTextures:
    """Albedo times light for every surface of a scene."""
    grids = irradiance(scene, light)
    indoor = np.concatenate([g.reshape(-1, 3).mean(axis=1) for g in grids if g.size])
    white = 22.0 * _ALBEDO * float(np.median(indoor))
    if white <= 0:
        raise SimulatorError(
            f"scene '{scene.name}' has no lamp, and in this light all of it is dark"
        )
    sun = light.sun_level * max(light.to_sun[2], 0.0)
    outdoors = sun * np.asarray(light.sun_rgb) + light.sky_level * np.asarray(light.sky_rgb)
    bank = TextureBank(scene.texture_seed)
    textures: list[U8] = []
    for index, (s, grid) in enumerate(zip(scene.surfaces, grids, strict=True)):
        if s.material == REFLECTION:  # codes go with the root of the radiance
            seen = textures[s.options["of"]][:, ::-1] * np.sqrt(s.options["share"])
            textures.append(np.rint(seen).astype(np.uint8))
            continue
        albedo = surface_albedo(bank, scene, index)
        columns, rows = s.size_texels
        if s.outside:
            radiance = albedo * (0.5 * outdoors).astype(np.float32)
        else:
            radiance = albedo * cv2.resize(grid, (columns, rows), interpolation=cv2.INTER_LINEAR)
        code = 255 * np.sqrt(np.clip(radiance / np.float32(white), 0, 1)) + 0.5
        textures.append(code.astype(np.uint8))
    return LitTextures(textures, white)


def surface_albedo(bank: TextureBank, scene: Scene, index: int) -> F32:
    """The texture of one surface: the same for every light and flight."""
    s = scene.surfaces[index]
    columns, rows = s.size_texels
    # Prints of one plate are equal: the option `print` numbers the plates.
    rng = np.random.default_rng([scene.texture_seed, s.options.get("print", index)])
    return SURFACES[s.material](bank, rows, columns, s.texels_per_m, rng, **s.options)
