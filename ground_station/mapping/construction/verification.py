"""The images' pairs that share a geometry: matched both ways and verified."""

from __future__ import annotations

from ground_station.errors import MapError
from ground_station.features.rootsift import RootSift
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.matching import TwoView, mutual_matches, verify
from ground_station.mapping.construction.pairs import choose_pairs
from ground_station.mapping.construction.workers import parallel
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress


def match(
    images: Images,
    camera: Camera,
    settings: MappingSettings,
    threads: int,
) -> dict[tuple[int, int], TwoView]:
    """Verified pairs (i, j) of images; raises `MapError` when no two images overlap."""
    descriptors = [features.descriptors for features in images.features]
    wanted = settings.match
    # Lowe's 0.8 is for SIFT. Of ALIKE's matches in the sample's mapping flight it leaves a third:
    # 47 verified pairs of 32 pictures, where 0.95 leaves 111.
    ratio = wanted.ratio if settings.features == RootSift.name else wanted.ratio_others
    matrix = camera.matrix

    def one(pair: tuple[int, int]) -> tuple[tuple[int, int], TwoView | None]:
        i, j = pair
        far = j - i > wanted.neighbours
        # Most pairs far apart share nothing, and a few of the strongest features tell: Wu,
        # "Towards linear-time incremental structure from motion", 3DV 2013, section 3.
        if far and wanted.preview:
            first, second = (descriptors[k][: wanted.preview] for k in pair)
            if len(mutual_matches(first, second, ratio)) < wanted.preview_matches:
                return pair, None
        matches = mutual_matches(descriptors[i], descriptors[j], ratio)
        least = wanted.min_inliers_far if far else wanted.min_inliers
        if len(matches) < least:
            return pair, None
        view = verify(
            images.pinhole_px[i],
            images.pinhole_px[j],
            matches,
            matrix,
            error_px=wanted.error_px,
            planar_ratio=wanted.planar_ratio,
        )
        if view is None or len(view.matches) < least:
            return pair, None
        # Repeated patterns look alike without sharing a geometry.
        if far and len(view.matches) < wanted.min_inlier_ratio * len(matches):
            return pair, None
        return pair, view

    pairs = choose_pairs(descriptors, wanted, settings.seed)
    verified: dict[tuple[int, int], TwoView] = {}
    with Progress("matching, pairs", len(pairs)) as progress:
        for pair, view in parallel(one, pairs, threads):
            if view is not None:
                verified[pair] = view
            progress.step()
    if not verified:
        raise MapError(
            f"no two of the {len(images.names)} images overlap: "
            f"no pair has {wanted.min_inliers} verified matches"
        )
    return verified
