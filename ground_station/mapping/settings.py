"""The settings of map building; the shipped `mapping.toml` says what every key is."""

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

    choose_above: int = config.key(160, unit="frames", low=0, high=1000000)
    parallax_deg: float = config.key(1.0, unit="deg", low=0.1, high=45.0)
    turn_deg: float = config.key(4.0, unit="deg", low=0.5, high=90.0)
    lost: float = config.key(0.2, low=0.05, high=0.5)
    min_sharpness: float = config.key(0.65, low=0.0, high=1.0)


@dataclass(frozen=True)
class ImportSettings:
    """Which images of a COLMAP model are compared."""

    min_shared: int = config.key(15, unit="points", low=1, high=10000)
    covisible: int = config.key(30, unit="images", low=1, high=1000)


@dataclass(frozen=True)
class MatchSettings:
    """Which images are compared, and which matches count."""

    pairs: str = config.key("auto", choices=("auto", "exhaustive"))
    exhaustive_max: int = config.key(64, unit="images", low=2, high=2000)
    neighbours: int = config.key(12, unit="images", low=1, high=1000)
    similar: int = config.key(8, unit="images", low=0, high=1000)
    similar_others: int = config.key(20, unit="images", low=0, high=1000)
    covisible: int = config.key(4, unit="images", low=0, high=1000)
    preview: int = config.key(400, unit="features", low=0, high=20000)
    preview_matches: int = config.key(5, unit="matches", low=1, high=1000)
    ratio: float = config.key(0.8, low=0.1, high=1.0)
    ratio_others: float = config.key(0.95, low=0.1, high=1.0)
    error_px: float = config.key(1.5, unit="px", low=0.1, high=20.0)
    planar_ratio: float = config.key(0.9, low=0.1, high=1.0)
    min_inliers: int = config.key(20, unit="matches", low=8, high=1000)
    min_inliers_far: int = config.key(30, unit="matches", low=8, high=1000)
    min_inlier_ratio: float = config.key(0.4, low=0.0, high=1.0)

    def of(self, features: str) -> MatchSettings:
        """These settings for features of that name: of all but RootSIFT what `_others` say."""
        if features == RootSift.name:
            return self
        return replace(self, ratio=self.ratio_others, similar=self.similar_others)


_LEAST_LOSS_PX = 0.1


@dataclass(frozen=True)
class SfmSettings:
    """Structure from motion and what is kept of it."""

    method: str = config.key("incremental", choices=("incremental", "global", "auto"))
    part_images: int = config.key(600, unit="images", low=50, high=20000)
    min_tri_angle_deg: float = config.key(1.5, unit="deg", low=0.0, high=45.0)
    min_track: int = config.key(2, unit="images", low=2, high=100)
    max_error_px: float = config.key(2.5, unit="px", low=0.1, high=20.0)
    loss_px: float = config.key(1.0, unit="px", low=_LEAST_LOSS_PX, high=100.0)
    max_jump: float = config.key(4.0, low=1.5, high=1000.0)
    rolling_shutter: bool = True


@dataclass(frozen=True)
class RefineSettings:
    """Which frames of a flight `blimp map refine` takes, and what it believes of them."""

    min_interval_s: float = config.key(0.25, unit="s", low=0.0, high=60.0)
    min_parallax_deg: float = config.key(2.0, unit="deg", low=0.0, high=90.0)
    min_turn_deg: float = config.key(8.0, unit="deg", low=0.0, high=180.0)
    max_frames: int = config.key(400, unit="frames", low=1, high=5000)
    min_observations: int = config.key(30, unit="observations", low=6, high=10000)
    max_misfit_px: float = config.key(5.0, unit="px", low=0.1, high=100.0)
    max_shift_px: float = config.key(10.0, unit="px", low=0.0, high=1000.0)
    twist_reach_s: float = config.key(0.1, unit="s", low=0.0, high=10.0)
    twist_gap_s: float = config.key(0.25, unit="s", low=0.0, high=10.0)
    keyframe_gap_s: float = config.key(1.0, unit="s", low=0.0, high=10.0)
    correlation: float = config.key(0.5, low=0.0, high=1.0)


@dataclass(frozen=True)
class ExtendSettings:
    """Which frames of a flight `blimp map extend` adds, and what it makes of their observations."""

    lost_interval_s: float = config.key(0.4, unit="s", low=0.0, high=60.0)
    min_moved_px: float = config.key(10.0, unit="px", low=0.0, high=1000.0)
    max_frames: int = config.key(400, unit="frames", low=2, high=5000)
    neighbours: int = config.key(8, unit="frames", low=1, high=1000)
    similar: int = config.key(4, unit="frames", low=0, high=1000)
    min_track: int = config.key(6, unit="frames", low=2, high=100)
    min_observations: int = config.key(30, unit="observations", low=6, high=10000)
    merge_px: float = config.key(1.0, unit="px", low=0.0, high=20.0)
    mode_distance: float = config.key(0.4, low=0.0, high=2.0)
    mode_spreads: float = config.key(1.5, low=0.0, high=100.0)
    max_modes: int = config.key(3, low=0, high=8)
    expected_often: int = config.key(10, unit="frames", low=1, high=10000)


@dataclass(frozen=True)
class MappingSettings:
    """How `blimp map build` works."""

    features: str = "rootsift"
    max_features: int = config.key(1500, unit="features", low=50, high=20000)
    max_images: int = config.key(1000, unit="images", low=2, high=20000)
    seed: int = config.key(0, low=0, high=2**31 - 1)
    threads: int = config.key(0, unit="threads", low=0, high=256)
    quantise: bool = True
    cache_gb: float = config.key(4.0, unit="GB", low=0.0, high=10000.0)
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
