"""The wiring as a drawing: an SVG made from `wiring.toml`, so that it cannot say otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from hw.builds import Build
from hw.parts import entries_of
from hw.quantities import HardwareError
from pi_firmware.wire import config

WIRING_FILE = Path(__file__).with_name("wiring.toml")
GAUGES = ("ina219", "max17048")
COLOURS = {
    "cell": "#c53030", "5V": "#dd6b20", "3V3": "#b7791f", "GND": "#1a202c", "SDA": "#2b6cb0",
    "SCL": "#2c7a7b", "tx": "#6b46c1", "rx": "#b83280", "CSI": "#718096",
}  # fmt: skip
_NAMES = {"cell": "cell +", "tx": "UART out of the Pi", "rx": "UART into the Pi",
          "CSI": "flat cable"}  # fmt: skip
_WHEN = (*GAUGES, "autopilot", "")
_COLUMNS_X = (20, 190, 400, 680, 990)
_WIDTHS = (100, 100, 150, 190, 150)
_HEAD, _PITCH, _TALL = 50, 24, 440


@dataclass(frozen=True)
class Device:
    """A box; its pins as "id, side, label, kind", from the top on each side."""

    id: str
    name: str
    note: str = ""
    when: str = config.key("", "where it is", choices=_WHEN)
    column: int = config.key(0, "from the left", low=0, high=4)
    top: int = config.key(0, "of the box", unit="px", low=0, high=_TALL)
    pins: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Wire:
    """Two ends, "device.pin" each; the first stands left of, or above, the second."""

    ends: list[str]
    lane: int = config.key(60, "before its right column", unit="px", low=5, high=200)
    when: str = config.key("", "where it is", choices=_WHEN)


@dataclass(frozen=True)
class Pin:
    """A pin where it is drawn."""

    side: str
    label: str
    kind: str
    x: int
    y: int
    column: int


@dataclass(frozen=True)
class Wiring:
    """What one variant has: boxes, their pins by "device.pin", and wires."""

    devices: tuple[Device, ...]
    pins: dict[str, Pin]
    wires: tuple[Wire, ...]


def variant_of(build: Build) -> tuple[str, bool]:
    """A build's gauge and whether it has an autopilot; raises `HardwareError`."""
    gauge = build.part("gauge")
    name = gauge.id.removeprefix("gauge-") if gauge else None
    if name not in GAUGES:
        raise HardwareError(f"build {build.name!r}: gauge {name!r}; allowed: {', '.join(GAUGES)}")
    return str(name), build.part("autopilot") is not None


def load_wiring(gauge: str, autopilot: bool, path: str | Path = WIRING_FILE) -> Wiring:
    """Reads one variant and checks every wire; raises a one-line error that names it."""
    here = {"", gauge} | ({"autopilot"} if autopilot else set())
    document = config.read(path)
    every = [
        config.from_mapping(entry, Device, where=f"{path}: device {entry.get('id')!r}")
        for entry in entries_of(document, "device", path)
    ]
    devices = tuple(device for device in every if device.when in here)
    known = {device.id for device in every}
    pins: dict[str, Pin] = {}
    for device in devices:
        rows = {"left": 0, "right": 0}
        for text in device.pins:
            pins[f"{device.id}.{text.split(',')[0].strip()}"] = _pin(device, text, rows, path)
    wires = []
    for entry in entries_of(document, "wire", path):
        wire = config.from_mapping(entry, Wire, where=f"{path}: wire {entry.get('ends')!r}")
        if len(wire.ends) != 2 or not {e.partition(".")[0] for e in wire.ends} <= known:
            raise HardwareError(f"{path}: wire {wire.ends!r} ends at a device that is not there")
        if wire.when in here and all(e.partition(".")[0] in {d.id for d in devices}
                                     for e in wire.ends):  # fmt: skip
            _check(wire, pins, path)
            wires.append(wire)
    return Wiring(devices, pins, tuple(wires))


def _pin(device: Device, text: str, rows: dict[str, int], path: str | Path) -> Pin:
    words = [word.strip() for word in text.split(",")]
    if len(words) != 4 or words[1] not in rows or words[3] not in COLOURS:
        raise HardwareError(
            f"{path}: pin {text!r} of {device.id!r}; allowed: id, left|right, label, kind of"
            f" {', '.join(COLOURS)}"
        )
    _, side, label, kind = words
    x = _COLUMNS_X[device.column] + (_WIDTHS[device.column] if side == "right" else 0)
    y = device.top + _HEAD + _PITCH * rows[side] + _PITCH // 2
    rows[side] += 1
    return Pin(side, label, kind, x, y, device.column)


def _check(wire: Wire, pins: dict[str, Pin], path: str | Path) -> None:
    for end in wire.ends:
        if end not in pins:
            raise HardwareError(f"{path}: wire {wire.ends!r}: there is no pin {end!r}")
    kinds = {pins[end].kind for end in wire.ends}
    if len(kinds) != 1 and kinds != {"tx", "rx"}:
        raise HardwareError(f"{path}: wire {wire.ends!r} joins {' and '.join(sorted(kinds))}")


def svg(wiring: Wiring, title: str) -> str:
    """The drawing, with its own background and no outside references."""
    wide = _COLUMNS_X[-1] + _WIDTHS[-1] + 20
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {_TALL}" width="{wide}"'
        f' height="{_TALL}" font-family="DejaVu Sans, Verdana, sans-serif" font-size="12">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{wide}" height="{_TALL}" fill="white"/>',
        f'<text x="20" y="28" font-size="16" font-weight="bold">{escape(title)}</text>',
    ]
    parts += [_wire(wire, wiring.pins) for wire in wiring.wires]
    parts += [text for device in wiring.devices for text in _box(device, wiring)]
    parts += _legend(wiring)
    return "\n".join([*parts, "</svg>", ""])


def _wire(wire: Wire, pins: dict[str, Pin]) -> str:
    a, b = (pins[end] for end in wire.ends)
    lane = _COLUMNS_X[b.column] - wire.lane
    kind = a.kind
    path = f"M{a.x} {a.y}H{lane}V{b.y}H{b.x}"
    return f'<path d="{path}" fill="none" stroke="{COLOURS[kind]}" stroke-width="2.5"/>'


def _box(device: Device, wiring: Wiring) -> list[str]:
    x, wide = _COLUMNS_X[device.column], _WIDTHS[device.column]
    own = [pin for name, pin in wiring.pins.items() if name.startswith(device.id + ".")]
    tall = max(pin.y for pin in own) + _PITCH // 2 + 6 - device.top
    parts = [
        f'<rect x="{x}" y="{device.top}" width="{wide}" height="{tall}" rx="6" fill="#f7fafc"'
        ' stroke="#2d3748" stroke-width="1.5"/>',
        f'<text x="{x + wide // 2}" y="{device.top + 20}" text-anchor="middle"'
        f' font-weight="bold">{escape(device.name)}</text>',
        f'<text x="{x + wide // 2}" y="{device.top + 36}" text-anchor="middle" font-size="10"'
        f' fill="#4a5568">{escape(device.note)}</text>',
    ]
    for pin in own:
        left = pin.side == "left"
        parts.append(f'<circle cx="{pin.x}" cy="{pin.y}" r="4" fill="{COLOURS[pin.kind]}"/>')
        parts.append(
            f'<text x="{pin.x + (9 if left else -9)}" y="{pin.y + 4}" font-size="11"'
            f' text-anchor="{"start" if left else "end"}">{escape(pin.label)}</text>'
        )
    return parts


def _legend(wiring: Wiring) -> list[str]:
    used = {wiring.pins[wire.ends[0]].kind for wire in wiring.wires}
    parts, x, y = [], 20, _TALL - 22
    for kind in (kind for kind in COLOURS if kind in used):
        name = _NAMES.get(kind, kind)
        parts.append(
            f'<path d="M{x} {y}h22" stroke="{COLOURS[kind]}" stroke-width="3"/>'
            f'<text x="{x + 28}" y="{y + 4}" font-size="11">{escape(name)}</text>'
        )
        x += 46 + 7 * len(name)
    return parts


def drawing(gauge: str, autopilot: bool = True) -> str:
    title = f"Payload with {gauge.upper()}" + (" and autopilot" if autopilot else "")
    return svg(load_wiring(gauge, autopilot), title)
