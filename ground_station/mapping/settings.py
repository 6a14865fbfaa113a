"""The settings of map building; the shipped `mapping.toml` documents every key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ground_station.features.methods.rootsift import RootSift
from ground_station.features.settings import LearnedSettings
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

SHIPPED = Path(__file__).with_name("mapping.toml")


@dataclass(frozen=True)
class KeyframeSettings:
    """Which frames of a long input become images."""

    choose_above: int = config.key(
        160, "inputs of together no more frames are used whole", unit="frames", low=0, high=1000000
    )
    parallax_deg: float = config.key(
        1.0, "a keyframe is due when the camera moved so far, seen from what it sees", unit="deg",
        low=0.1, high=45.0,
    )  # fmt: skip
    turn_deg: float = config.key(
        4.0, "or turned so far, since the last one", unit="deg", low=0.5, high=90.0
    )
    lost: float = config.key(
        0.2, "or so large a share of what it saw is no longer seen", low=0.05, high=0.5
    )
    min_sharpness: float = config.key(
        0.65, "a frame less sharp than this share of those around it is blurred", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class ImportSettings:
    """Which images of a COLMAP model are compared."""

    min_shared: int = config.key(
        15, "of the model, that two images share which are compared", unit="points",
        low=1, high=10000,
    )  # fmt: skip
    covisible: int = config.key(
        30, "each with so many that share most", unit="images", low=1, high=1000
    )


@dataclass(frozen=True)
class MatchSettings:
    """Which images are compared, and which matches count."""

    pairs: str = config.key(
        "auto", "exhaustive: every pair is compared", choices=("auto", "exhaustive")
    )
    exhaustive_max: int = config.key(
        64, "auto: up to so many images, every pair is compared", unit="images", low=2, high=2000
    )
    neighbours: int = config.key(
        12,
        "above that: each image with some of so many that follow it",
        unit="images",
        low=1,
        high=1000,
    )
    similar: int = config.key(
        8, "above that: and with so many that look like it, of RootSIFT", unit="images", low=0,
        high=1000,
    )  # fmt: skip
    similar_others: int = config.key(
        20, "the same of other features, whose key points are less exact: more pairs to average",
        unit="images", low=0, high=1000,
    )  # fmt: skip
    covisible: int = config.key(
        4,
        "above that: and with so many that share strong links with it, but were not compared",
        unit="images",
        low=0,
        high=1000,
    )
    preview: int = config.key(
        400,
        "of images far apart, first so many of the strongest features",
        unit="features",
        low=0,
        high=20000,
    )
    preview_matches: int = config.key(
        5, "must give so many matches, or the pair is left out", unit="matches", low=1, high=1000
    )
    ratio: float = config.key(
        0.8, "a match's distance over its runner-up's, both ways, of RootSIFT", low=0.1, high=1.0
    )
    ratio_others: float = config.key(
        0.95, "the same of other features, whose distances differ less", low=0.1, high=1.0
    )
    error_px: float = config.key(
        1.5,
        "distance from the epipolar line; more where the images' own noise is larger",
        unit="px",
        low=0.1,
        high=20.0,
    )
    planar_ratio: float = config.key(
        0.9, "share explained by a homography that makes a pair degenerate", low=0.1, high=1.0
    )
    min_inliers: int = config.key(
        20, "verified matches of a neighbouring pair", unit="matches", low=8, high=1000
    )
    min_inliers_far: int = config.key(
        30, "verified matches of a pair far apart in time", unit="matches", low=8, high=1000
    )
    min_inlier_ratio: float = config.key(
        0.4, "verified matches over all, of a pair far apart in time", low=0.0, high=1.0
    )

    def of(self, features: str) -> MatchSettings:
        """These settings for features of that name: of all but RootSIFT what `_others` say."""
        if features == RootSift.name:
            return self
        return replace(self, ratio=self.ratio_others, similar=self.similar_others)


_LEAST_LOSS_PX = 0.1


@dataclass(frozen=True)
class SfmSettings:
    """Structure from motion and what is kept of it."""

    method: str = config.key(
        "incremental",
        "of structure from motion; auto: global, and incremental where that leaves images out",
        choices=("incremental", "global", "auto"),
    )
    part_images: int = config.key(
        600, "of more, overlapping parts of about so many are made beside each other and joined",
        unit="images", low=50, high=20000,
    )  # fmt: skip
    min_tri_angle_deg: float = config.key(
        1.5, "a landmark's largest angle between two observations", unit="deg", low=0.0, high=45.0
    )
    min_track: int = config.key(
        3, "images that must have seen a landmark", unit="images", low=2, high=100
    )
    max_error_px: float = config.key(
        2.5, "reprojection error of an observation", unit="px", low=0.1, high=20.0
    )
    loss_px: float = config.key(
        1.0, "scale of the adjustments' Cauchy loss where the images' noise is not known",
        unit="px", low=_LEAST_LOSS_PX, high=100.0,
    )  # fmt: skip
    max_jump: float = config.key(
        4.0, "a frame is dropped when its step is so many times a fast one", low=1.5, high=1000.0
    )
    rolling_shutter: bool = config.key(
        True, "take it out of the finished map, by the camera's readout time"
    )


@dataclass(frozen=True)
class RefineSettings:
    """Which frames of a flight `blimp map refine` takes, and what it believes of them."""

    min_interval_s: float = config.key(
        0.25, "between two frames that are taken", unit="s", low=0.0, high=60.0
    )
    min_parallax_deg: float = config.key(
        2.0, "a frame is taken when it moved so far, seen from what it sees", unit="deg",
        low=0.0, high=90.0,
    )  # fmt: skip
    min_turn_deg: float = config.key(
        8.0, "or turned so far, since the last one taken", unit="deg", low=0.0, high=180.0
    )
    max_frames: int = config.key(
        400, "of all flights together; more are thinned evenly", unit="frames", low=1, high=5000
    )
    min_observations: int = config.key(
        30, "of a frame that is taken", unit="observations", low=6, high=10000
    )
    max_misfit_px: float = config.key(
        5.0,
        "median error of a frame's observations in the map as it was",
        unit="px",
        low=0.1,
        high=100.0,
    )
    max_shift_px: float = config.key(
        10.0, "a frame in which the readout moved one pixel in ten further is too fast", unit="px",
        low=0.0, high=1000.0,
    )  # fmt: skip
    twist_reach_s: float = config.key(
        0.1, "a frame's velocity comes from poses so near", unit="s", low=0.0, high=10.0
    )
    twist_gap_s: float = config.key(
        0.25, "or from its neighbours, where they are so near", unit="s", low=0.0, high=10.0
    )
    keyframe_gap_s: float = config.key(
        1.0, "a keyframe's velocity comes from its neighbours, where they are so near", unit="s",
        low=0.0, high=10.0,
    )  # fmt: skip
    correlation: float = config.key(
        0.5, "share of an observation's error that all of a landmark in one flight have in common",
        low=0.0, high=1.0,
    )  # fmt: skip


@dataclass(frozen=True)
class ExtendSettings:
    """Which frames of a flight `blimp map extend` adds, and what it makes of their observations."""

    lost_interval_s: float = config.key(
        0.4, "of a stretch that is not localized, a frame is tried so often", unit="s",
        low=0.0, high=60.0,
    )  # fmt: skip
    min_moved_px: float = config.key(
        10.0, "and only when its features moved so far since the one before", unit="px",
        low=0.0, high=1000.0,
    )  # fmt: skip
    max_frames: int = config.key(
        400, "of all flights together; more are thinned evenly", unit="frames", low=2, high=5000
    )
    neighbours: int = config.key(
        8, "each frame is compared with so many that follow it", unit="frames", low=1, high=1000
    )
    similar: int = config.key(
        4, "and with so many that show most of the same landmarks", unit="frames", low=0, high=1000
    )
    min_track: int = config.key(
        6, "frames that must have seen a new landmark", unit="frames", low=2, high=100
    )
    min_observations: int = config.key(
        30, "of a frame that joins", unit="observations", low=6, high=10000
    )
    merge_px: float = config.key(
        1.0, "what is seen so near to a landmark is that landmark", unit="px", low=0.0, high=20.0
    )
    mode_distance: float = config.key(
        0.4, "a landmark looks otherwise when its descriptor is so far off", low=0.0, high=2.0
    )
    mode_spreads: float = config.key(
        1.5, "and off by so many times its spread in the map", low=0.0, high=100.0
    )
    max_modes: int = config.key(3, "further descriptors of a landmark", low=0, high=8)
    expected_often: int = config.key(
        10, "a landmark this often in view that is never seen is counted", unit="frames",
        low=1, high=10000,
    )  # fmt: skip


@dataclass(frozen=True)
class MappingSettings:
    """How `blimp map build` works."""

    features: str = config.key("rootsift", "name of the extractor or of a model")
    max_features: int = config.key(
        1500, "features of an image, the strongest", unit="features", low=50, high=20000
    )
    max_images: int = config.key(
        160,
        "of a longer input the keyframes, at most so many; a step in the range goes before",
        unit="images",
        low=2,
        high=20000,
    )
    seed: int = config.key(0, "of every random choice", low=0, high=2**31 - 1)
    threads: int = config.key(0, "worker threads, 0: one a core", unit="threads", low=0, high=256)
    quantise: bool = config.key(True, "keep descriptors as one byte a number")
    cache_gb: float = config.key(
        4.0, "of features and pairs on disk, the oldest go first; 0: none", unit="GB",
        low=0.0, high=10000.0,
    )  # fmt: skip
    learned: LearnedSettings = field(default_factory=LearnedSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    sfm: SfmSettings = field(default_factory=SfmSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    extend: ExtendSettings = field(default_factory=ExtendSettings)
    importing: ImportSettings = field(default_factory=ImportSettings)

    def with_noise(self, noise_px: float | None) -> MappingSettings:
        """With the adjustments' loss as wide as a key point's noise, where it is known.

        What misses by more is of little weight then: right matches of real walls have long tails,
        and along a corridor a few hundred of these bend a map by centimetres.
        """
        if noise_px is None:
            return self
        return replace(self, sfm=replace(self.sfm, loss_px=max(noise_px, _LEAST_LOSS_PX)))


def load_settings(path: str | Path | None = None) -> MappingSettings:
    """Reads a settings file, the shipped one by default; raises `ConfigError` with one line."""
    document = config.read(path or SHIPPED)
    sfm = document.get("sfm")
    if isinstance(sfm, dict) and "refine_camera" in sfm:
        raise ConfigError(
            f"{path}: the key 'sfm.refine_camera' is gone, take it out: a lens that misfits is "
            "refined without being asked, a build without --camera finds its own"
        )
    return config.from_mapping(document, MappingSettings, where=str(path or SHIPPED))


def with_changes(
    settings: MappingSettings, changes: Mapping[str, Any], where: str
) -> MappingSettings:
    """The settings with other values for some keys, as `seed` or `match.pairs`; None changes none.

    Raises `ConfigError` with one line that begins with `where`, by the same checks as a file's.
    """
    document = asdict(settings)
    for name, value in changes.items():
        *tables, key = name.split(".")
        table = document
        for inner in tables:
            table = table[inner]
        if value is not None:
            table[key] = value
    return config.from_mapping(document, MappingSettings, where=where)
