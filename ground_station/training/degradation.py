"""What light, lens, sensor and link do to views, many at once: `feature_models.degrade` in torch.

In the order in which it happens: light, shadow and gloss, defocus and motion along a path, exposure
and tone curve, noise, compression. The other one encodes in earnest and needs no torch, which
models that users bring are measured without. Views are (V, H, W), 0..1 as codes outside and linear
in between. H and W are multiples of 8.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.training.views import Chance

_LIGHT, _SHADOW, _GLOSS = 0.7, 0.35, 0.2
_DEFOCUS, _MOTION = 0.35, 0.4
_TONE, _NOISE, _COMPRESSION = 0.85, 0.8, 0.6
"""How often each happens; it is then of a random strength."""
_REACH = 8
"""Pixels that a blur reaches to each side."""


def degraded(codes: Tensor, chance: Chance) -> Tensor:
    """Views as a payload in other light might have sent them: rounded to 255 steps."""
    count = len(codes)
    linear = codes**2.2
    linear = _some(linear, _lit(linear, chance), _LIGHT, chance)
    linear = _some(linear, _shadowed(linear, chance), _SHADOW, chance)
    linear = _some(linear, _glossy(linear, chance), _GLOSS, chance)
    kernels, motion = _blurs(count, chance)
    linear = functional.conv2d(
        functional.pad(linear[None], (_REACH,) * 4, mode="reflect"), kernels[:, None], groups=count
    )[0].clamp(min=0)
    made = _some(linear.clamp(min=1e-6) ** (1 / 2.2), _developed(linear, chance), _TONE, chance)
    made = _some(made, _noisy(made, chance), _NOISE, chance).clamp(0, 1)
    made = _some(made, _compressed(made, motion, chance), _COMPRESSION, chance)
    return (made.clamp(0, 1) * 255).round() / 255


def _some(before: Tensor, after: Tensor, share: float, chance: Chance) -> Tensor:
    return torch.where(chance.happens(share, len(before), 1, 1), after, before)


def _grid(like: Tensor) -> tuple[Tensor, Tensor]:
    y = torch.linspace(-1, 1, like.shape[1], device=like.device)[None, :, None]
    return y, torch.linspace(-1, 1, like.shape[2], device=like.device)[None, None, :]


def _lit(linear: Tensor, chance: Chance) -> Tensor:
    """A gradient over the picture, cones of lamps, the lens's vignette."""
    count = len(linear)
    y, x = _grid(linear)
    angle, slope = chance.uniform(0, 2 * math.pi, count, 1, 1), chance.normal(0.6, count, 1, 1)
    factor = (slope * (angle.cos() * x + angle.sin() * y)).exp()
    for share in (0.75, 0.5, 0.25):
        cx, cy = (chance.uniform(-1.2, 1.2, count, 1, 1) for _ in "xy")
        turn, wide = chance.uniform(0, math.pi, count, 1, 1), chance.uniform(0.15, 1, count, 1, 1)
        a = turn.cos() * (x - cx) + turn.sin() * (y - cy)
        b = (turn.cos() * (y - cy) - turn.sin() * (x - cx)) * chance.uniform(1, 3, count, 1, 1)
        strength = chance.uniform(0.3, 4, count, 1, 1) * chance.happens(share, count, 1, 1)
        factor = factor + strength * (-(a * a + b * b) / wide**2).exp()
    factor = factor * (1 - chance.uniform(0, 0.45, count, 1, 1) * (x * x + y * y) / 2)
    return linear * factor / factor.mean(dim=(1, 2), keepdim=True)


def _shadowed(linear: Tensor, chance: Chance) -> Tensor:
    """Bars of a window's frame and corners of things, with soft edges."""
    count = len(linear)
    y, x = _grid(linear)
    soft = chance.uniform(0.01, 0.08, count, 1, 1)
    angle = chance.uniform(0, math.pi, count, 1, 1)
    across = angle.cos() * x + angle.sin() * y
    period, wide = chance.uniform(0.15, 1, count, 1, 1), chance.uniform(0.1, 0.6, count, 1, 1)
    phase = ((across / period + chance.uniform(0, 1, count, 1, 1)) % 1 - 0.5).abs() * period
    bars = torch.sigmoid((wide * period / 2 - phase) / soft)
    patch = torch.ones_like(bars)
    cx, cy = (chance.uniform(-0.8, 0.8, count, 1, 1) for _ in "xy")
    for _ in range(4):
        turn, far = (chance.uniform(0, 2 * math.pi, count, 1, 1),
                     chance.uniform(0.1, 0.9, count, 1, 1))  # fmt: skip
        side = far - (turn.cos() * (x - cx) + turn.sin() * (y - cy))
        patch = patch * torch.sigmoid(side / soft)
    mask = torch.where(chance.happens(0.5, count, 1, 1), bars, patch)
    return linear * (1 - chance.uniform(0.3, 0.9, count, 1, 1) * mask)


def _glossy(linear: Tensor, chance: Chance) -> Tensor:
    """Something else mirrored dimly in the wall, out of focus."""
    other = linear.roll(2, 0).flip(2)[:, None]
    small = functional.avg_pool2d(other, 8)
    mirrored = functional.interpolate(small, linear.shape[1:], mode="bilinear")[:, 0]
    return linear + chance.uniform(0.05, 0.6, len(linear), 1, 1) * mirrored


def _blurs(count: int, chance: Chance) -> tuple[Tensor, Tensor]:
    """Kernels (V, 17, 17), each a disc moved along a bent path, and the motion (V, 2), px."""
    device = chance.generator.device
    step = torch.arange(-_REACH, _REACH + 1, device=device, dtype=torch.float32)
    radius = 0.45 * (chance.uniform(1e-6, 1, count) * chance.uniform(1e-6, 1, count)).log().neg()
    radius = torch.where(chance.happens(_DEFOCUS, count), radius.clamp(max=4), 0)[:, None, None]
    motion = chance.normal(1, count, 2) * chance.uniform(0.5, 4, count, 1)
    motion = torch.where(chance.happens(_MOTION, count, 1), motion, 0).clamp(-10, 10)
    bend = chance.normal(1, count, 1) * motion.flip(1)
    bend[:, 0].neg_()
    disc = (radius + 0.5 - torch.hypot(step[None, :, None], step[None, None, :])).clamp(0, 1)
    line = torch.zeros(count, len(step), len(step), device=device)
    parts = 4 * _REACH
    for t in (torch.arange(parts, device=device) + 0.5) / parts - 0.5:
        # The bend's mean is nought, so that nothing shifts.
        at = motion * t + bend * (t * t - 1 / 12)
        wx, wy = ((1 - (at[:, k, None] - step).abs()).clamp(min=0) for k in (0, 1))
        line += wy[:, :, None] * wx[:, None, :]
    kernel = functional.conv2d(line[None], disc[:, None], padding=_REACH, groups=count)[0]
    return kernel / kernel.sum(dim=(1, 2), keepdim=True), motion


def _developed(linear: Tensor, chance: Chance) -> Tensor:
    """Exposure, Reinhard's shoulder (SIGGRAPH 2002, eq. 4), gamma and a contrast curve's S."""
    count = len(linear)
    target = (math.log(0.19) + chance.normal(0.55, count, 1, 1)).exp()
    level = linear * target / linear.mean(dim=(1, 2), keepdim=True).clamp(min=1e-4)
    level = level * (1 + level / chance.uniform(2, 8, count, 1, 1) ** 2) / (1 + level)
    code = level.clamp(1e-6, 1) ** (1 / chance.uniform(1.6, 2.8, count, 1, 1))
    code = code + chance.uniform(-0.3, 0.9, count, 1, 1) * (code * code * (3 - 2 * code) - code)
    hazy = code * chance.uniform(0.25, 1, count, 1, 1) + chance.uniform(0, 0.3, count, 1, 1)
    return _some(code, hazy, 0.3, chance)


def _noisy(code: Tensor, chance: Chance) -> Tensor:
    """Shot noise, which grows with the light, and the noise of reading; sometimes scaled up."""
    gain = chance.uniform(math.log(0.003), math.log(0.05), len(code), 1, 1).exp()
    grain = chance.normal(1, *code.shape)
    wide = 3 * functional.avg_pool2d(grain[:, None], 3, 1, 1)[:, 0]
    grain = _some(grain, wide, 0.3, chance)
    return code + gain * (0.25 + code.clamp(0, 1)).sqrt() * grain


def _compressed(code: Tensor, motion: Tensor, chance: Chance) -> Tensor:
    """As H.264 leaves a predicted picture: what differs from the one before, moved, in coarse
    steps of 4x4 or 8x8 transforms (ITU-T H.264, 8.5; the step doubles every six of the quantizer).
    """
    count = len(code)
    shift = -2 * (2 * motion + chance.normal(0.2, count, 2))
    shift = shift / torch.tensor(code.shape[:0:-1], device=code.device)
    matrix = torch.zeros(count, 2, 3, device=code.device)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, :, 2] = 1, 1, shift
    grid = functional.affine_grid(matrix, [count, 1, *code.shape[1:]], align_corners=False)
    before = functional.grid_sample(
        code[:, None], grid, padding_mode="border", align_corners=False
    )[:, 0] + chance.normal(0.01, *code.shape)
    step = 2 ** ((chance.uniform(20, 40, count, 1, 1) - 4) / 6) / 255
    side = 4 if float(chance.uniform(0, 1, 1)) < 0.5 else 8
    known = _in_steps(before, step, side)
    back = functional.affine_grid(
        torch.cat([matrix[:, :, :2], -matrix[:, :, 2:]], dim=2), [count, 1, *code.shape[1:]],
        align_corners=False,
    )  # fmt: skip
    guess = functional.grid_sample(
        known[:, None], back, padding_mode="border", align_corners=False
    )[:, 0]
    # An IDR has nothing to be predicted from.
    guess = torch.where(chance.happens(0.2, count, 1, 1), torch.full_like(guess, 0.5), guess)
    return guess + _in_steps(code - guess, step, side)


def _in_steps(values: Tensor, step: Tensor, side: int) -> Tensor:
    """Values (V, H, W) with their transforms' coefficients rounded towards nought."""
    k = torch.arange(side, device=values.device, dtype=torch.float32)
    basis = (math.pi / side * (k[None] + 0.5) * k[:, None]).cos() * math.sqrt(2 / side)
    basis[0] *= math.sqrt(0.5)
    count, rows, columns = values.shape
    blocks = values.view(count, rows // side, side, columns // side, side).transpose(2, 3)
    made = basis @ blocks @ basis.T
    size = step[:, :, :, None, None]
    made = made.sign() * size * (made.abs() / size + 1 / 3).floor()
    blocks = basis.T @ made @ basis
    return blocks.transpose(2, 3).reshape(count, rows, columns)
