"""Pictures made by code with the statistics of natural ones: no camera, no data set.

Dead leaves (occlusion at all scales: Lee, Mumford and Huang 2001) whose leaves have textures of
their own, fields of amplitude 1/f (Field 1987), and man-made shapes: chequers, gratings, polygons,
lines, letters, walls of the simulator's materials. Grey, (H, W) uint8.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np

from ground_station.arrays import F32, U8
from ground_station.simulator.textures import MATERIALS, TextureBank

Rng = np.random.Generator
Kind = Callable[[tuple[int, int], Rng], tuple[F32, F32]]
"""Paints a patch and its mask, both (rows, columns), of linear radiance and 0..1."""

HELD_OUT = {"carpet", "laminate", "panelling", "screen", "tiles", "wallpaper"}
"""Materials of the buildings in which localizers are judged: no network sees them before."""
_PER_BANK = 40
"""Pictures that share a bank of fields: a bank takes as long as several pictures."""
_OVER = 1.5
"""Painted larger and made smaller by the mean, as a sensor's pixels see edges."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_LETTERS = list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&?%+=/<>#@")


@functools.lru_cache(maxsize=1)
def _bank(seed: int, number: int) -> TextureBank:
    return TextureBank(int(np.random.SeedSequence([seed, 7, number]).generate_state(1)[0]))


def procedural(seed: int, index: int, size: tuple[int, int]) -> U8:
    """Picture `index` of a seed, (rows, columns); the same each time."""
    rng = np.random.default_rng([seed, 1, index])
    bank = _bank(seed, index // _PER_BANK)
    painters = (leaves, leaves, leaves, field, walls, walls, shapes, shapes, plain, rows, screens)
    painter = painters[index % len(painters)]
    large = (round(size[0] * _OVER), round(size[1] * _OVER))
    radiance = painter(bank, large, rng)
    small = cv2.resize(radiance, size[::-1], interpolation=cv2.INTER_AREA)
    return _coded(np.asarray(small, np.float32), rng)


def _coded(radiance: F32, rng: Rng) -> U8:
    """Linear radiance to eight bits: its 1st and 99th percentile to a random range, gamma 2.2."""
    low, high = np.percentile(radiance[::4, ::4], (1, 99))
    level = (radiance - low) / max(high - low, 1e-6)
    bottom, top = rng.uniform(0, 0.06), rng.uniform(0.5, 1)
    code = np.clip(bottom + (top - bottom) * level, 0, 1) ** (1 / 2.2)
    return np.asarray(255 * code + 0.5, np.uint8)


def leaves(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """Opaque leaves over each other, radii of a power law with exponent -3, each textured."""
    rows, columns = size
    canvas = _texture(bank, size, rng)
    low, high = float(rng.uniform(3, 9)), float(rng.uniform(0.15, 0.4) * columns)
    u = rng.random(6000)
    radii = (low**-2 + u * (high**-2 - low**-2)) ** -0.5
    cover = rng.uniform(1.2, 2.5) * rows * columns
    count = min(len(radii), int(np.searchsorted(np.cumsum(np.pi * radii**2), cover)))
    round_ones = rng.random()
    sheet = _texture(bank, size, rng)
    for k in range(count):
        if k % 40 == 0:
            sheet = _texture(bank, size, rng)
        _leaf(canvas, sheet, float(radii[k]), rng.random() < round_ones, rng)
    return canvas


def _leaf(canvas: F32, sheet: F32, radius: float, is_round: bool, rng: Rng) -> None:
    """One leaf, cut from a sheet at a place of its own, in place."""
    rows, columns = canvas.shape
    x, y = rng.uniform(0, columns), rng.uniform(0, rows)
    reach = int(np.ceil(radius)) + 1
    x0, y0 = max(0, int(x) - reach), max(0, int(y) - reach)
    x1, y1 = min(columns, int(x) + reach + 1), min(rows, int(y) + reach + 1)
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    centre = (x - x0, y - y0)
    if is_round:
        axes = (2 * radius, 2 * radius * rng.uniform(0.4, 1))
        cv2.ellipse(mask, (centre, axes, float(rng.uniform(0, 180))), 255, -1)
    else:
        angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius + centre
        cv2.fillPoly(mask, [np.rint(ring).astype(np.int32)], 255)
    shade = np.float32(np.exp(rng.normal(0, 0.7)))
    # Many leaves are nearly flat, as walls are.
    flat = np.float32(rng.random() ** 2)
    cut = sheet[y0:y1, x0:x1]
    piece = shade * (flat * cut + (1 - flat))
    block = canvas[y0:y1, x0:x1]
    np.copyto(block, piece, where=mask > 0)


def _texture(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """A factor about 1 from one of the bank's fields, stretched at random, never below 0.05."""
    fields = (*bank.coarse, *bank.middle, bank.fine, bank.leaves - 0.5, bank.chips - 0.5)
    one = fields[int(rng.integers(len(fields)))]
    zoom = np.exp(rng.normal(0.2, 0.5, 2))
    window = bank.window(one, *size, rng, float(zoom[0]), float(zoom[1]))
    return np.asarray(np.maximum(1 + np.float32(rng.uniform(0.05, 0.5)) * window, 0.05), np.float32)


def field(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """Sums and products of 1/f fields, some of them cut at a level: clouds, stains, coastlines."""
    result = _texture(bank, size, rng)
    for _ in range(int(rng.integers(1, 4))):
        mask = bank.window(bank.coarse[1], *size, rng, float(np.exp(rng.normal(0, 0.4))))
        other = _texture(bank, size, rng) * np.float32(np.exp(rng.normal(0, 0.6)))
        result = np.where(mask > rng.normal(0, 0.7), other, result)
    return np.asarray(result, np.float32)


def walls(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """Quadrilaterals of the simulator's materials at random angles, over each other."""
    rows, columns = size
    canvas = _texture(bank, size, rng) * np.float32(0.3)
    names = sorted(set(MATERIALS) - HELD_OUT)
    for _ in range(int(rng.integers(4, 14))):
        name = names[int(rng.integers(len(names)))]
        h, w = int(rng.uniform(0.2, 0.9) * rows), int(rng.uniform(0.2, 0.7) * columns)
        options = {"text": _word(rng)} if name in ("poster", "door") else {}
        scale = float(rng.uniform(60, 240))
        albedo = MATERIALS[name](bank, h, w, scale, rng, **options) @ _LUMINANCE
        light = np.float32(np.exp(rng.normal(0, 0.6)))
        corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
        place = rng.uniform(-0.2, 0.9, 2) * (columns, rows)
        bent = corners + place + rng.normal(0, 0.12, (4, 2)) * (w, h)
        turn = cv2.getRotationMatrix2D(bent.mean(axis=0).tolist(), float(rng.normal(0, 20)), 1.0)
        bent = bent @ turn[:, :2].T + turn[:, 2]
        matrix = cv2.getPerspectiveTransform(corners, bent.astype(np.float32))
        cv2.warpPerspective(
            np.ascontiguousarray(albedo * light), matrix, (columns, rows), dst=canvas,
            flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT,
        )  # fmt: skip
    return canvas


def plain(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """A corridor's walls: faint grain, light that falls off, edges of panels, few small things."""
    high, wide = size
    grain = _texture(bank, size, rng) - 1
    canvas = 1 + np.float32(np.exp(rng.uniform(np.log(0.03), np.log(0.5)))) * grain
    for _ in range(int(rng.integers(1, 5))):  # walls, floor and doors meet along straight lines
        place, way = rng.uniform(0, 1, 2) * (wide, high), rng.normal(0, 1, 2)
        far = way / np.hypot(*way) * (wide + high)
        side = np.array([-far[1], far[0]])
        mask = np.zeros(size, np.float32)
        corners = np.array([place - far, place + far, place + far + side, place - far + side])
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1.0, cv2.LINE_AA)
        canvas = canvas * (1 + np.float32(rng.normal(0, 0.25)) * mask)
    kinds = (_polygon, _lines, _text, _grating)
    for _ in range(int(rng.integers(1, 9))):
        canvas = _put(canvas, kinds[int(rng.integers(len(kinds)))], (0.03, 0.25), rng)
    return np.asarray(np.maximum(canvas, 0.02), np.float32)


def rows(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """The same thing again and again, as doors and lamps are, with small differences between."""
    high, wide = size
    motif = walls if rng.random() < 0.5 else shapes
    h, w = (int(side / rng.integers(2, 6)) for side in size)
    one = cv2.resize(motif(bank, (2 * h, 2 * w), rng), (w, h), interpolation=cv2.INTER_AREA)
    tiles = np.tile(one, (-(-high // h), -(-wide // w)))[:high, :wide]
    canvas = np.asarray(tiles * _texture(bank, size, rng), np.float32)
    for _ in range(int(rng.integers(0, 12))):
        canvas = _put(canvas, _text if rng.random() < 0.6 else _polygon, (0.04, 0.15), rng)
    return canvas


def screens(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """Bright rectangles with writing in a dim room."""
    canvas = walls(bank, size, rng) * np.float32(rng.uniform(0.1, 0.6))
    for _ in range(int(rng.integers(1, 5))):
        canvas = _put(canvas, _text, (0.2, 0.6), rng, float(rng.uniform(1, 4)))
    return np.asarray(canvas, np.float32)


def _put(canvas: F32, kind: Kind, share: tuple[float, float], rng: Rng, level: float = 1.0) -> F32:
    """A shape of some share of the picture's sides, turned, over the canvas."""
    rows, columns = canvas.shape
    h, w = (int(side * np.exp(rng.uniform(*np.log(share)))) + 8 for side in canvas.shape)
    patch, mask = kind((h, w), rng)
    turn = cv2.getRotationMatrix2D((w / 2, h / 2), float(rng.normal(0, 35)), 1.0)
    x, y = rng.uniform(-0.2, 1.0, 2) * (columns, rows)
    turn = turn + np.array([[0, 0, x], [0, 0, y]])
    over = cv2.warpAffine(mask, turn, (columns, rows), flags=cv2.INTER_LINEAR)
    tone = cv2.warpAffine(patch, turn, (columns, rows), flags=cv2.INTER_LINEAR)
    return np.asarray(canvas * (1 - over) + np.float32(level) * tone * over, np.float32)


def _word(rng: Rng) -> str:
    return "".join(rng.choice(_LETTERS, int(rng.integers(1, 9))).tolist())


def shapes(bank: TextureBank, size: tuple[int, int], rng: Rng) -> F32:
    """What people make: chequers, gratings, polygons, lines, discs and letters on a background."""
    canvas = _texture(bank, size, rng) if rng.random() < 0.7 else np.ones(size, np.float32)
    canvas = canvas * np.float32(rng.uniform(0.1, 0.8))
    kinds = (_chequers, _grating, _polygon, _lines, _text, _text, _polygon)
    for _ in range(int(rng.integers(8, 40))):
        canvas = _put(canvas, kinds[int(rng.integers(len(kinds)))], (0.06, 0.5), rng)
    grime = _texture(bank, size, rng)
    return np.asarray(canvas * (0.6 + 0.4 * grime), np.float32)


def _tones(rng: Rng, count: int) -> F32:
    return np.exp(rng.uniform(np.log(0.04), 0, count)).astype(np.float32)


def _chequers(size: tuple[int, int], rng: Rng) -> tuple[F32, F32]:
    step = int(rng.integers(5, 40))
    y, x = np.mgrid[: size[0], : size[1]]
    tones = _tones(rng, 2)
    return tones[((x // step) + (y // step)) % 2], np.ones(size, np.float32)


def _grating(size: tuple[int, int], rng: Rng) -> tuple[F32, F32]:
    y, x = np.mgrid[: size[0], : size[1]]
    period, angle = rng.uniform(5, 40), rng.uniform(0, np.pi)
    wave = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
    if rng.random() < 0.5:
        wave = np.sign(wave)
    tones = _tones(rng, 2)
    return (tones[0] + (tones[1] - tones[0]) * (wave + 1) / 2).astype(np.float32), np.ones(
        size, np.float32
    )


def _polygon(size: tuple[int, int], rng: Rng) -> tuple[F32, F32]:
    mask = np.zeros(size, np.float32)
    angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 9))))
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.5, 1, (len(angle), 1))
    corners = (ring + 1) / 2 * (size[1] - 1, size[0] - 1)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1.0, cv2.LINE_AA)
    ramp = np.linspace(1, rng.uniform(0.5, 1.6), size[1], dtype=np.float32)
    return np.broadcast_to(_tones(rng, 1) * ramp, size).copy(), mask


def _lines(size: tuple[int, int], rng: Rng) -> tuple[F32, F32]:
    mask = np.zeros(size, np.float32)
    for _ in range(int(rng.integers(1, 9))):
        ends = (rng.uniform(0, 1, (2, 2)) * (size[1], size[0])).astype(int)
        width = int(rng.integers(1, 6))
        cv2.line(mask, ends[0].tolist(), ends[1].tolist(), 1.0, width, cv2.LINE_AA)
    return np.full(size, _tones(rng, 1)[0], np.float32), mask


def _text(size: tuple[int, int], rng: Rng) -> tuple[F32, F32]:
    """Words in OpenCV's fonts, with or without a plate behind them."""
    paper, ink = _tones(rng, 2).tolist()
    patch = np.full(size, paper, np.float32)
    ground = 1.0 if rng.random() < 0.5 else 0.0
    mask = np.full(size, ground, np.float32)
    fonts = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX,
             cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)  # fmt: skip
    font = fonts[int(rng.integers(len(fonts)))]
    height = max(8, int(rng.uniform(0.12, 0.8) * size[0]))
    for bottom in range(height, size[0] + 1, round(1.25 * height) + 1):
        place = (int(rng.integers(0, 6)), bottom - round(0.2 * height))
        style = (height / 30, ink, max(1, round(height / 14)), cv2.LINE_AA)
        word = " ".join(_word(rng) for _ in range(int(rng.integers(1, 4))))
        cv2.putText(patch, word, place, font, *style)
        if not ground:
            cv2.putText(mask, word, place, font, height / 30, 1.0, style[2], cv2.LINE_AA)
    return (np.full(size, ink, np.float32) if not ground else patch), mask
