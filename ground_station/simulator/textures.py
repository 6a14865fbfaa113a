"""Textures made by code, with the statistics of real surfaces: 1/f fields, dead leaves, grain.

Natural images have a power spectrum near 1/f² (Field 1987) and occlusion edges at all scales,
which the dead-leaves model gives (Lee, Mumford and Huang 2001). All textures are linear albedo,
float32 (rows, columns, 3) RGB.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32

Rng = np.random.Generator

_FIELD_SIZE = 1024


def power_law_field(size: int, exponent: float, rng: Rng) -> F32:
    """A periodic field (size, size) of amplitude f^-exponent, zero mean and unit deviation."""
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)).astype(np.float32))
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    f[0, 0] = 1
    spectrum *= (f**-exponent).astype(np.float32)
    spectrum[0, 0] = 0
    result = np.fft.irfft2(spectrum, s=(size, size)).astype(np.float32)
    return np.asarray(result / result.std())


def dead_leaves(size: int, low_px: float, high_px: float, rng: Rng) -> F32:
    """Opaque discs, radii of a power law (exponent -3), over each other: (size, size), 0 to 1."""
    canvas = np.full((size, size), 0.5, np.float32)
    # Enough area to cover the canvas about three times.
    u = rng.random(200_000)
    radii = (low_px**-2 + u * (high_px**-2 - low_px**-2)) ** -0.5
    count = min(len(radii), int(np.searchsorted(np.cumsum(np.pi * radii**2), 3.0 * size * size)))
    centres = rng.uniform(-high_px, size + high_px, (count, 2))
    shades = rng.random(count)
    axes = rng.uniform(0.5, 1.0, count)
    angles = rng.uniform(0, 180, count)
    for centre, radius, shade, axis, angle in zip(
        centres.tolist(), radii.tolist(), shades.tolist(), axes.tolist(), angles.tolist(),
        strict=False,
    ):  # fmt: skip
        box = (centre, (2 * radius, 2 * radius * axis), angle)
        cv2.ellipse(canvas, box, shade, -1, cv2.LINE_AA)
    return canvas


class TextureBank:
    """Fields shared by all materials of a scene; each surface cuts its own windows from them."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.coarse = [power_law_field(_FIELD_SIZE, e, rng) for e in (1.6, 1.4)]
        self.middle = [power_law_field(_FIELD_SIZE, e, rng) for e in (1.1, 1.0)]
        self.fine = power_law_field(_FIELD_SIZE, 0.7, rng)
        self.leaves = dead_leaves(_FIELD_SIZE, 3, 90, rng)
        self.chips = dead_leaves(_FIELD_SIZE, 1.2, 9, rng)

    def window(
        self, field: F32, rows: int, columns: int, rng: Rng, zoom_x: float = 1.0,
        zoom_y: float | None = None,
    ) -> F32:  # fmt: skip
        """A random window of a field, mirrored at its borders, magnified in x, and in y alike.

        With another `zoom_y` it is stretched: grain and brushed metal.
        """
        zoom_y = zoom_x if zoom_y is None else zoom_y
        h, w = max(2, round(rows / zoom_y)), max(2, round(columns / zoom_x))
        y = (int(rng.integers(_FIELD_SIZE)) + np.arange(h)) % _FIELD_SIZE
        x = (int(rng.integers(_FIELD_SIZE)) + np.arange(w)) % _FIELD_SIZE
        cut: npt.NDArray[Any] = field[np.ix_(y, x)]
        if rng.random() < 0.5:
            cut = cut[:, ::-1]
        if (h, w) != (rows, columns):
            cut = cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_CUBIC)
        return np.ascontiguousarray(cut, dtype=np.float32)


def _paint(shade: F32, rgb: tuple[float, float, float]) -> F32:
    return np.clip(shade, 0.03, 2.5)[..., None] * np.asarray(rgb, np.float32)


def _grime(bank: TextureBank, rows: int, columns: int, rng: Rng, amount: float) -> F32:
    """A factor near 1: clouds of dirt, and a few stains and scratches that no other surface has."""
    shade = 1 + amount * 0.5 * bank.window(bank.coarse[0], rows, columns, rng)
    shade += amount * 0.45 * bank.window(bank.middle[0], rows, columns, rng)
    area = rows * columns / 150.0**2  # in squares of about a metre
    for _ in range(min(40, int(rng.poisson(1.6 * area + 0.4)))):
        centre = (int(rng.integers(columns)), int(rng.integers(rows)))
        axes = (int(rng.uniform(2, 22)), int(rng.uniform(2, 16)))
        spot = (
            float(rng.uniform(0.55, 0.9)) if rng.random() < 0.7 else float(rng.uniform(1.05, 1.25))
        )
        patch = np.ones_like(shade[: 4 * axes[1] + 5, : 4 * axes[0] + 5])
        middle = (patch.shape[1] // 2, patch.shape[0] // 2)
        cv2.ellipse(patch, middle, axes, float(rng.uniform(0, 180)), 0, 360, spot, -1, cv2.LINE_AA)
        if rng.random() < 0.5:
            patch = cv2.GaussianBlur(patch, (0, 0), 1.5)
        y, x = centre[1] - middle[1], centre[0] - middle[0]
        y0, x0 = max(y, 0), max(x, 0)
        y1, x1 = min(y + patch.shape[0], rows), min(x + patch.shape[1], columns)
        if y1 > y0 and x1 > x0:
            shade[y0:y1, x0:x1] *= patch[y0 - y : y1 - y, x0 - x : x1 - x]
    for _ in range(min(20, int(rng.poisson(0.7 * area)))):
        a = (int(rng.integers(columns)), int(rng.integers(rows)))
        b = (a[0] + int(rng.normal(0, 40)), a[1] + int(rng.normal(0, 25)))
        line = np.ones_like(shade)
        cv2.line(line, a, b, float(rng.uniform(0.7, 0.9)), 1, cv2.LINE_AA)
        shade *= line
    return shade


def _joints(shade: F32, step_px: tuple[float, float], width_px: int, depth: float) -> None:
    """Darkens joint lines of a grid that starts at the top-left corner, in place."""
    rows, columns = shade.shape
    for k in range(int(columns / step_px[0]) + 1):
        x = round(k * step_px[0])
        shade[:, max(0, x - width_px // 2) : x + (width_px + 1) // 2] *= depth
    for k in range(int(rows / step_px[1]) + 1):
        y = round(k * step_px[1])
        shade[max(0, y - width_px // 2) : y + (width_px + 1) // 2, :] *= depth


def plaster(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Painted plaster: faint 1/f shading, trowel marks, dirt."""
    shade = _grime(b, rows, columns, rng, o.get("dirt", 0.16))
    shade += 0.05 * b.window(b.fine, rows, columns, rng)
    return _paint(shade, o.get("rgb", (0.62, 0.58, 0.50)))


def concrete(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Cast concrete: clouds, pores, streaks of water, form ties on a regular grid."""
    shade = _grime(b, rows, columns, rng, 0.24)
    shade += 0.10 * b.window(b.middle[1], rows, columns, rng, 0.5, 4.0)
    pores = b.window(b.chips, rows, columns, rng)
    shade *= np.where(pores > 0.93, 0.62, 1).astype(np.float32)
    tie = o.get("tie_m", 0.0) * scale
    if tie:
        for y in np.arange(tie / 2, rows, tie):
            for x in np.arange(tie / 2, columns, tie):
                cv2.circle(shade, (round(x), round(y)), max(1, round(0.018 * scale)), 0.35, -1)
    band = o.get("band")  # (bottom, top in metres, colour): a painted ring
    image = _paint(shade, o.get("rgb", (0.42, 0.41, 0.39)))
    if band:
        y0, y1 = (rows - round(z * scale) for z in (band[1], band[0]))
        image[max(0, y0) : max(0, y1)] = _paint(shade, band[2])[max(0, y0) : max(0, y1)]
    return image


def terrazzo(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Terrazzo slabs: chips of stone in cement, joints, slabs of slightly different shades."""
    step = o.get("slab_m", 1.0) * scale
    shade = _grime(b, rows, columns, rng, 0.16)
    for y in range(round(rows / step) + 1):
        for x in range(round(columns / step) + 1):
            cell = np.s_[
                round(y * step) : round((y + 1) * step), round(x * step) : round((x + 1) * step)
            ]
            shade[cell] *= rng.uniform(0.86, 1.14)
    chips = b.window(b.chips, rows, columns, rng)
    shade *= 0.72 + 0.65 * chips
    _joints(shade, (step, step), max(1, round(0.010 * scale)), 0.45)
    image = _paint(shade, o.get("rgb", (0.50, 0.46, 0.40)))
    image[..., 0] *= 1 + 0.15 * (chips > 0.8)
    return image


def wood(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Planks along x (or y with `upright`): stretched grain, one shade a plank, dark joints."""
    upright = o.get("upright", False)
    h, w = (columns, rows) if upright else (rows, columns)
    plank = max(4, round(o.get("plank_m", 0.14) * scale))
    shade = np.empty((h, w), np.float32)
    for top in range(0, h, plank):
        n = min(plank, h - top)
        grain = b.window(b.middle[0], n, w, rng, 14.0, 0.9)
        rings = np.sin(6 * b.window(b.coarse[1], n, w, rng, 8.0, 1.2)).astype(np.float32)
        shade[top : top + n] = rng.uniform(0.72, 1.25) * (1 + 0.16 * grain + 0.10 * rings)
        shade[top] *= 0.45
    if upright:
        shade = np.ascontiguousarray(shade.T)
    shade *= _grime(b, rows, columns, rng, 0.10)
    return _paint(shade, o.get("rgb", (0.36, 0.22, 0.12)))


def brick(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Running bond: 250 x 71 mm with 10 mm mortar, every brick burnt differently."""
    height, width, joint = 0.081 * scale, 0.26 * scale, max(1, round(0.012 * scale))
    image = _paint(np.full((rows, columns), 1.0, np.float32), (0.42, 0.40, 0.36))
    colour = np.asarray(o.get("rgb", (0.36, 0.17, 0.11)), np.float32)
    for course in range(int(rows / height) + 1):
        y0, y1 = round(course * height), round((course + 1) * height) - joint
        for k in range(-1, int(columns / width) + 1):
            x0 = round((k + 0.5 * (course % 2)) * width)
            x1 = x0 + round(width) - joint
            tone = colour * rng.lognormal(0, 0.38) * (1 + 0.08 * rng.standard_normal(3))
            image[max(0, y0) : max(0, y1), max(0, x0) : max(0, x1)] = tone
    shade = _grime(b, rows, columns, rng, 0.18) + 0.12 * b.window(b.fine, rows, columns, rng)
    return np.asarray(image * np.clip(shade, 0.05, 2)[..., None], np.float32)


def fabric(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Upholstery: folds and a woven pattern of soft blotches."""
    shade = _grime(b, rows, columns, rng, 0.22) * (
        0.7 + 0.6 * b.window(b.leaves, rows, columns, rng)
    )
    return _paint(shade, o.get("rgb", (0.12, 0.20, 0.34)))


def metal(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Brushed and worn metal."""
    shade = _grime(b, rows, columns, rng, 0.18)
    shade += 0.10 * b.window(b.middle[0], rows, columns, rng, 10.0, 0.8)
    return _paint(shade, o.get("rgb", (0.30, 0.31, 0.33)))


def foliage(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Leaves over leaves, light and dark."""
    leaf = b.window(b.leaves, rows, columns, rng, o.get("zoom", 0.6))
    shade = (0.25 + 1.5 * leaf * leaf) * _grime(b, rows, columns, rng, 0.35)
    return _paint(shade, o.get("rgb", (0.09, 0.17, 0.05)))


def sky(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Clouds before a blue that pales towards the horizon (the bottom)."""
    cloud = 1 / (1 + np.exp(-2.0 * (b.window(b.coarse[1], rows, columns, rng, 1.5) - 0.2)))
    pale = np.linspace(0, 1, rows, dtype=np.float32)[:, None, None]
    blue = np.array([0.35, 0.50, 0.80], np.float32) * (1 - pale) + 0.85 * pale
    white = np.float32(0.95)
    return np.asarray(blue * (1 - cloud[..., None]) + white * cloud[..., None], np.float32)


def door(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """A door leaf: frame, panels, handle, and a number plate."""
    image = wood(b, rows, columns, scale, rng, upright=True, rgb=o.get("rgb", (0.30, 0.17, 0.09)))
    border = round(0.14 * scale)
    for y0, y1 in ((0.08, 0.48), (0.54, 0.94)):
        top, bottom = round(y0 * rows), round(y1 * rows)
        cv2.rectangle(image, (border, top), (columns - border, bottom), (0.05, 0.03, 0.02), 3)
        image[top + 8 : bottom - 8, border + 8 : columns - border - 8] *= 1.18
    cv2.circle(image, (columns - round(0.09 * scale), round(0.52 * rows)), 5, (0.6, 0.5, 0.3), -1)
    if "text" in o:
        x, y = round(0.3 * columns), round(0.2 * rows)
        cv2.rectangle(
            image, (x, y), (x + round(0.4 * columns), y + round(0.16 * scale)), (0.75,) * 3, -1
        )
        _write(
            image, o["text"], (x + 3, y + round(0.13 * scale)), round(0.38 * columns), (0.05,) * 3
        )
    return image


def _write(
    image: F32, text: str, left_bottom: tuple[int, int], width_px: int, rgb: tuple[float, ...]
) -> None:
    font, thickness = cv2.FONT_HERSHEY_DUPLEX, 2
    (w, _), _ = cv2.getTextSize(text, font, 1.0, thickness)
    size = width_px / max(w, 1)
    thick = max(1, round(2.2 * size))
    cv2.putText(image, text, left_bottom, font, size, rgb, thick, cv2.LINE_AA)


def poster(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """A printed sign, unlike any other: headline, a picture of shapes, lines of text.

    Another `edition` is another picture in the same place.
    """
    if edition := o.get("edition", 0):
        rng = np.random.default_rng([edition, int(rng.integers(2**32))])
    hue = rng.random(3)
    background = np.clip(0.25 + 0.6 * hue, 0, 0.85).astype(np.float32)
    tones = 0.02 + 0.12 * rng.random(3) if background.mean() > 0.4 else 0.6 + 0.3 * rng.random(3)
    ink = tuple(float(v) for v in tones)
    image = np.empty((rows, columns, 3), np.float32)
    image[:] = background
    margin = max(2, round(0.06 * columns))
    top, bottom = round(0.24 * rows), round(0.72 * rows)
    picture = image[top:bottom, margin : columns - margin]
    ph, pw = picture.shape[:2]
    ramp = b.window(b.coarse[0], ph, pw, rng)[..., None]
    picture *= np.clip(1 + 0.35 * ramp, 0.2, 1.6)
    canvas = np.ascontiguousarray(picture)
    for _ in range(int(rng.integers(12, 30))):
        colour = tuple(float(v) for v in rng.uniform(0.03, 0.8, 3))
        x, y, r = rng.uniform(0, pw), rng.uniform(0, ph), rng.uniform(0.03, 0.25) * min(ph, pw)
        if rng.random() < 0.4:
            cv2.circle(canvas, (round(x), round(y)), round(r), colour, -1, cv2.LINE_AA)
        else:
            angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
            shape = np.stack([x + r * np.cos(angle), y + r * np.sin(angle)], axis=1)
            cv2.fillPoly(canvas, [np.round(shape).astype(np.int32)], colour, cv2.LINE_AA)
    picture[:] = canvas
    headline = o.get("text", "ATRIUM")
    _write(image, headline, (margin, round(0.18 * rows)), columns - 2 * margin, ink)
    letters = "ABCDEFGHIKLMNOPRSTUVWabcdefghiklmnoprstuvw0123456789 "
    for k in range(5):
        line = "".join(rng.choice(list(letters), int(rng.integers(12, 22))))
        y = round((0.78 + 0.045 * k) * rows)
        _write(
            image, line, (margin, y), round(rng.uniform(0.6, 0.95) * (columns - 2 * margin)), ink
        )
    cv2.rectangle(image, (1, 1), (columns - 2, rows - 2), ink, 3)
    shade = 1 + 0.06 * b.window(b.coarse[1], rows, columns, rng)
    return (image * shade[..., None]).astype(np.float32)


def carpet(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Loops of wool, worn where people walk, with lanes of another shade."""
    shade = _grime(b, rows, columns, rng, 0.15) + 0.12 * b.window(b.fine, rows, columns, rng)
    lane = max(2, round(0.5 * scale))
    shade *= np.where((np.arange(columns) // lane) % 2, 0.9, 1.05).astype(np.float32)
    return _paint(shade, o.get("rgb", (0.20, 0.21, 0.24)))


def tiles(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Glazed tiles of 200 mm, all but equal, with light joints."""
    step = 0.2 * scale
    shade = np.ones((rows, columns), np.float32)
    for y in range(int(rows / step) + 1):
        for x in range(int(columns / step) + 1):
            shade[round(y * step) : round((y + 1) * step),
                  round(x * step) : round((x + 1) * step)] = rng.normal(1.0, 0.025)  # fmt: skip
    _joints(shade, (step, step), max(1, round(0.006 * scale)), 1.3)
    shade *= 1 + 0.05 * b.window(b.coarse[0], rows, columns, rng)
    return _paint(shade, o.get("rgb", (0.60, 0.62, 0.62)))


def wallpaper(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """One motif every 530 mm, a roll's width: nothing but dirt tells one repeat from the next."""
    side = max(4, round(0.53 * scale))
    motif = b.window(b.leaves, side, side, np.random.default_rng(int(rng.integers(2))))
    repeat = np.tile(motif, (rows // side + 1, columns // side + 1))[:rows, :columns]
    shade = (0.8 + 0.4 * repeat) * _grime(b, rows, columns, rng, 0.05)
    return _paint(shade, o.get("rgb", (0.55, 0.50, 0.44)))


def laminate(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """A smooth sheet, nearly blank, with a seam every 1.2 m."""
    shade = 1 + 0.03 * b.window(b.coarse[1], rows, columns, rng)
    shade += 0.015 * b.window(b.fine, rows, columns, rng)
    _joints(shade, (1.2 * scale, 2.4 * scale), max(1, round(0.004 * scale)), 0.7)
    return _paint(shade, o.get("rgb", (0.66, 0.66, 0.64)))


def panelling(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """Acoustic boards of 600 mm, perforated in a regular grid."""
    shade = _grime(b, rows, columns, rng, 0.08)
    pitch, radius = 0.05 * scale, max(1, round(0.008 * scale))
    for y in np.arange(pitch / 2, rows, pitch):
        for x in np.arange(pitch / 2, columns, pitch):
            cv2.circle(shade, (round(float(x)), round(float(y))), radius, 0.45, -1, cv2.LINE_AA)
    _joints(shade, (0.6 * scale, 0.6 * scale), max(1, round(0.008 * scale)), 0.6)
    return _paint(shade, o.get("rgb", (0.58, 0.56, 0.52)))


def screen(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """A monitor that shows windows and lines of text, in a black rim."""
    image = np.full((rows, columns, 3), 0.03, np.float32)
    rim = max(1, round(0.02 * scale))
    image[rim:-rim, rim:-rim] = rng.uniform(0.1, 0.9, 3)
    for _ in range(4):
        x, y = int(rng.uniform(0.05, 0.5) * columns), int(rng.uniform(0.05, 0.5) * rows)
        w, h = int(rng.uniform(0.2, 0.45) * columns), int(rng.uniform(0.2, 0.45) * rows)
        image[y : y + h, x : x + w] = rng.uniform(0.6, 0.95)
        for line in range(y + 3, y + h - 2, max(3, round(0.02 * scale))):
            image[line : line + 1, x + 2 : x + 2 + int(rng.uniform(0.3, 0.95) * w)] = 0.08
    return image


def charuco(b: TextureBank, rows: int, columns: int, scale: float, rng: Rng, **o: Any) -> F32:
    """A calibration board of squares of 25 mm in toner on paper, with a white margin of one."""
    side = round(0.025 * scale)
    squares = (columns // side - 2, rows // side - 2)
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(squares, 1.0, 0.75, markers)
    ink = np.full((rows, columns), 255, np.uint8)
    drawn = board.generateImage((squares[0] * side, squares[1] * side), marginSize=0)
    ink[side : side + drawn.shape[0], side : side + drawn.shape[1]] = drawn
    shade = np.where(ink > 127, np.float32(1), np.float32(0.05))
    return _paint(shade, (0.80, 0.80, 0.78))


_PAINTERS: tuple[Callable[..., F32], ...] = (
    plaster, concrete, terrazzo, wood, brick, fabric, metal, foliage, sky, door, poster, carpet,
    tiles, wallpaper, laminate, panelling, screen,
)  # fmt: skip
MATERIALS = {painter.__name__: painter for painter in _PAINTERS}
"""What rooms are made of, and networks learn from: another one would change all their pictures."""
SURFACES: dict[str, Callable[..., F32]] = MATERIALS | {charuco.__name__: charuco}
