"""`ground_station.map.floorplan`: floorplan.yaml and the picture that it names."""

from __future__ import annotations

from pieces import Picker, refusing, scratch, stretch

from ground_station.errors import InputError
from ground_station.map.floorplan import load_floorplan
from readers.image import png

_FOLDER = scratch("floorplan")
_YAML = (
    b"image: floorplan.png\nresolution: 0.025\norigin: [-0.75, -0.75, 0.0]\n"
    b"negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
(_FOLDER / "floorplan.png").write_bytes(png(8, 8, bytes(9) * 8))


def fuzz(data: bytes) -> None:
    """What is taken has finite numbers."""
    picker = Picker(data)
    path = _FOLDER / "floorplan.yaml"
    if picker.number(1) % 2:
        lines = _YAML.splitlines(keepends=True)
        lines[picker.number(1) % len(lines)] = picker.rest() + b"\n"
        path.write_bytes(b"".join(lines))
    else:
        path.write_bytes(picker.rest())
    with refusing(InputError):
        plan = load_floorplan(path)
        assert plan.size_m[0] > 0 and abs(sum(plan.origin)) < float("inf")


def seeds() -> list[bytes]:
    """The sample's; aliases that multiply, dates that are none, nests, numbers in base 60."""
    laughs = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
        b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % (to, to, *[of] * 9)
        for of, to in zip(b"abcdefgh", b"bcdefghi", strict=True)
    )
    return [
        b"\0" + _YAML,
        b"\0" + _YAML.replace(b"0.025", b"2001-13-41"),
        b"\0" + _YAML.replace(b"0.025", b"1" + b"0" * 400),
        b"\0" + _YAML.replace(b"0.025", b"0x" + b"f" * 400),
        b"\0" + _YAML.replace(b"0.025", b".nan"),
        b"\0" + _YAML.replace(b"floorplan.png", b"/dev/zero"),
        b"\0" + _YAML.replace(b"floorplan.png", b'"a\\0b"'),
        b"\0" + laughs + b"image: *i\nresolution: 1\norigin: [0,0,0]\n",
        b"\0" + _YAML.replace(b"-0.75", b"=", 1),
        b"\0" + _YAML.replace(b"-0.75", b"!!python/object:os.system x", 1),
        b"\0? [a]\n: b\n",
        stretch((1, b"\0"), (5000, b"[")),
        stretch((1, b"\0"), (50_000, b"- ")),
        stretch((1, b"\0a: "), (20_000, b"1:"), (1, b"1")),
    ]
