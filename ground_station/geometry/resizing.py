"""A camera for pictures of another size or turned by quarters: key points and lens must agree."""

from __future__ import annotations

from dataclasses import replace

from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera

_ROUNDED_PX = 1.0
"""Who scales pictures rounds their sides, to even numbers at most: 1920x1080 becomes 854x480."""


def scaled(camera: Camera, width_px: int, height_px: int) -> Camera:
    """The camera of the same pictures, scaled to that size.

    What keeps its place is the picture's border, half a pixel outside of the first pixel's centre:
    c' + 1/2 = s (c + 1/2). The lens's numbers are of the plane z = 1 and stay.
    """
    sx, sy = width_px / camera.width_px, height_px / camera.height_px
    return replace(
        camera,
        width_px=width_px,
        height_px=height_px,
        fx_px=sx * camera.fx_px,
        fy_px=sy * camera.fy_px,
        cx_px=sx * (camera.cx_px + 0.5) - 0.5,
        cy_px=sy * (camera.cy_px + 0.5) - 0.5,
    )


def turned(camera: Camera, quarters: int) -> Camera:
    """The camera of the same pictures, turned clockwise by so many quarters.

    A quarter takes the pixel (u, v) of a picture of height H to (H - 1 - v, u), and the ray (x, y)
    to (-y, x), from which the tangential numbers p1, p2 become p2, -p1. The readout stays what it
    is, of the sensor's rows.
    """
    for _ in range(quarters % 4):
        camera = replace(
            camera,
            width_px=camera.height_px,
            height_px=camera.width_px,
            fx_px=camera.fy_px,
            fy_px=camera.fx_px,
            cx_px=camera.height_px - 1 - camera.cy_px,
            cy_px=camera.cx_px,
            p1=camera.p2,
            p2=0.0 - camera.p1,  # never -0.0, which a file would show
        )
    return camera


def for_pictures(
    camera: Camera, size_px: tuple[int, int], display_deg: int, of: str
) -> tuple[Camera, str]:
    """The camera for pictures of a size (width, height), and what is to say of it, or nothing.

    Pictures are taken as they are stored, as the sensor gives them; displays turn them clockwise by
    `display_deg` (0, 90, 180, 270). A camera of their size is theirs. One that has their sides
    swapped was calibrated with pictures as displays show them, where the flag explains it, and is
    turned to the stored ones. One of the same shape is scaled. Raises `CameraError`, which begins
    with `of`, the pictures' input, for any other.
    """
    width, height = size_px
    size, theirs = f"{width}x{height}", f"{camera.width_px}x{camera.height_px}"
    if (width, height) == (camera.width_px, camera.height_px):
        return camera, ""
    if _same_shape(camera, width, height):
        return scaled(camera, width, height), (
            f"{of}: its pictures are {size}, the camera's {theirs}: the camera is scaled, which is "
            f"right where both show the same view; if this size is a crop, calibrate at {size}"
        )
    swapped = turned(camera, 1)
    if not _same_shape(swapped, width, height):
        raise CameraError(
            f"{of}: its pictures are {size}, the camera's {theirs}, another shape, so that one is "
            f"a crop of the other: calibrate at {size} (blimp calibrate), or film at {theirs}"
        )
    if display_deg not in (90, 270):
        raise CameraError(
            f"{of}: its pictures are {size}, the camera's {theirs}: they were turned by a quarter, "
            "and no rotation flag says which way; calibrate with pictures that stand like these "
            "(blimp calibrate), or use the file as the camera wrote it"
        )
    # The camera is of what displays show, so that it turns back.
    upright = turned(camera, -display_deg // 90)
    said = (
        f"{of}: its pictures are stored as {size} and shown turned by {display_deg}°, as the "
        f"camera's {theirs} are: the camera is turned to the stored ones"
    )
    if (upright.width_px, upright.height_px) != (width, height):
        upright, said = scaled(upright, width, height), f"{said} and scaled"
    return upright, said


def misfit(camera: Camera, width_px: int, height_px: int) -> str:
    """Of a picture that has not the camera's size: both sizes, and what to do, for an error."""
    size, theirs = f"{width_px}x{height_px}", f"{camera.width_px}x{camera.height_px}"
    if _same_shape(turned(camera, 1), width_px, height_px):
        how = ("lies", "stands upright") if width_px > height_px else ("stands upright", "lies")
        fix = (
            f"it {how[0]}, the camera's picture {how[1]}: hold the camera as when it was"
            " calibrated, or calibrate it like this (blimp calibrate)"
        )
    else:
        fix = f"use pictures of {theirs}, or calibrate at {size} (blimp calibrate)"
    return f"{size} pixels, the camera {theirs}: {fix}"


def _same_shape(camera: Camera, width: int, height: int) -> bool:
    """Whether a size is the camera's times a factor, but for a side's rounding."""
    return (
        abs(width - height * camera.width_px / camera.height_px) <= _ROUNDED_PX
        or abs(height - width * camera.height_px / camera.width_px) <= _ROUNDED_PX
    )
