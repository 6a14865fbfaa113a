"""Every constant of the localizer, and the presets that ship: `default.toml` says what each is.

Defaults are the thesis's way, of which a preset or a file of one's own says what is otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ground_station.features.settings import FeatureSettings
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

_FOLDER = Path(__file__).with_name("presets")
PRESETS = tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))
"""By name; each is a file of its own."""
WIDTH_PX = 640
"""Of the pictures for which pixels are named; radii and windows are as large a part of others."""


@dataclass(frozen=True)
class GateSettings:
    """Which frames are not worth solving."""

    min_entropy_bits: float = config.key(0.0, unit="bits", low=0, high=8)
    min_contrast: float = config.key(0.0, unit="grey levels", low=0, high=255)


@dataclass(frozen=True)
class MotionSettings:
    """How the next frame's pose is predicted."""

    model: str = config.key("constant_velocity", choices=["static", "constant_velocity", "blimp"])
    max_step_s: float = config.key(1.0, unit="s", low=0.001, high=10)
    coast_s: float = config.key(0.5, unit="s", low=0, high=10)
    rotation_density_rad2_s3: float = config.key(1e-4, unit="rad2/s3", low=1e-5, high=1e3)
    translation_density_m2_s3: float = config.key(1e-3, unit="m2/s3", low=1e-5, high=1e3)
    density_limit: float = config.key(1e5, low=1, high=1e9)
    density_time_s: float = config.key(0.3, unit="s", low=0.03, high=60)
    walk_rotation_rad2_s: float = config.key(0.02, unit="rad2/s", low=1e-9, high=1e3)
    walk_translation_m2_s: float = config.key(0.02, unit="m2/s", low=1e-9, high=1e3)
    drag_time_s: float = config.key(20.0, unit="s", low=0.1, high=1000)
    pitch_period_s: float = config.key(3.4, unit="s", low=0.2, high=60)
    roll_period_s: float = config.key(1.5, unit="s", low=0.2, high=60)
    swing_damping: float = config.key(0.12, low=0, high=0.99)
    swing_arm_m: float = config.key(0.42, unit="m", low=0, high=10)
    rest_time_s: float = config.key(20.0, unit="s", low=0.1, high=1000)
    smoother_lag_s: float = config.key(1.0, unit="s", low=0.1, high=5)


@dataclass(frozen=True)
class ProjectionSettings:
    """Which landmarks are looked for."""

    viewing_cone: bool = False
    cone_margin_deg: float = config.key(30.0, unit="deg", low=0, high=180)
    max_distance_ratio: float = config.key(2.5, low=1, high=100)
    covisibility: bool = False


@dataclass(frozen=True)
class AssociationSettings:
    """Which feature is which landmark."""

    radius_px: float = config.key(40.0, unit="px", low=1, high=500)
    max_descriptor_distance: float = config.key(0.7, low=0, high=2)
    scale_distances: bool = False
    max_ratio: float = config.key(1.0, low=0.1, high=1)
    max_chance_share: float = config.key(1.0, low=0.001, high=1)
    refine_radius_px: float = config.key(0.0, unit="px", low=0, high=500)


@dataclass(frozen=True)
class PoseSettings:
    """How a pose is solved from its observations, and when it is believed."""

    solver: str = config.key("graph", choices=["graph", "rolling"])
    sigma_px: float = config.key(5.0, unit="px", low=0.1, high=50)
    huber_k: float = config.key(1.345, low=0.1, high=100)
    landmark_sigma_m: float = config.key(0.01, unit="m", low=1e-6, high=10)
    max_iterations: int = config.key(30, low=1, high=500)
    max_observations: int = config.key(400, low=6, high=10000)
    min_observations: int = config.key(12, low=4, high=1000)
    inlier_px: float = config.key(12.0, unit="px", low=0.5, high=100)
    min_inliers: int = config.key(12, low=4, high=1000)
    min_inlier_share: float = config.key(0.35, low=0, high=1)
    reject_outliers: bool = False
    rolling_shutter: bool = False


@dataclass(frozen=True)
class TrackingSettings:
    """How matched points are followed between the frames that are described."""

    enabled: bool = False
    max_points: int = config.key(300, low=12, high=2000)
    window_px: int = config.key(21, unit="px", low=5, high=63)
    levels: int = config.key(3, low=1, high=6)
    max_return_px: float = config.key(0.7, unit="px", low=0.05, high=10)
    max_difference: float = config.key(0.5, low=0, high=8)
    sigma_px: float = config.key(3.0, unit="px", low=0.1, high=50)
    min_inliers: int = config.key(10, low=6, high=1000)
    doubt_distance: float = config.key(0.3, low=0.01, high=2)
    min_significance: float = config.key(7.0, low=0, high=1000)
    min_found_share: float = config.key(0.1, low=0, high=1)
    max_chance_share: float = config.key(1.0, low=0.001, high=1)
    keyframe_min_points: int = config.key(20, low=6, high=1000)
    keyframe_parallax_px: float = config.key(100.0, unit="px", low=1, high=10000)
    keyframe_interval_s: float = config.key(0.2, unit="s", low=0, high=10)
    keyframe_min_share: float = config.key(0.6, low=0, high=1)
    describe_gap_s: float = config.key(0.09, unit="s", low=0, high=1000)
    features_lag_s: float = config.key(0.16, unit="s", low=0, high=10)


@dataclass(frozen=True)
class StartSettings:
    """What is believed of a pose that did not come from the frame before."""

    sigma_m: float = config.key(0.3, unit="m", low=0.001, high=10)
    sigma_deg: float = config.key(5.0, unit="deg", low=0.01, high=90)
    speed_m_s: float = config.key(1.5, unit="m/s", low=0.001, high=50)
    turn_deg_s: float = config.key(40.0, unit="deg/s", low=0.1, high=1000)


@dataclass(frozen=True)
class BlurSettings:
    """How much less an observation weighs in a blurred frame."""

    enabled: bool = False
    sigma_per_px: float = config.key(0.12, low=0, high=2)
    plain_sharpness: float = config.key(0.75, low=0.05, high=1)
    recent_frames: int = config.key(30, low=1, high=1000)


@dataclass(frozen=True)
class StateSettings:
    """When a localizer calls itself degraded or lost."""

    lost_after_s: float = config.key(0.0, unit="s", low=0, high=60)
    confirm_frames: int = config.key(1, low=0, high=100)
    sure_significance: float = config.key(1e9, low=0, high=1e9)
    recover_frames: int = config.key(0, low=0, high=100)
    good_inliers: int = config.key(25, low=4, high=1000)
    good_inlier_share: float = config.key(0.0, low=0, high=1)
    good_spread: float = config.key(0.06, low=0, high=0.5)
    good_sigma_m: float = config.key(1000.0, unit="m", low=0, high=1000)
    good_sigma_deg: float = config.key(360.0, unit="deg", low=0, high=360)
    good_residual_px: float = config.key(1000.0, unit="px", low=0, high=1000)
    good_sharpness: float = config.key(0.0, low=0, high=1)
    max_innovation: float = config.key(1e9, low=0, high=1e9)
    max_support_s: float = config.key(1000.0, unit="s", low=0, high=1000)


@dataclass(frozen=True)
class CovarianceSettings:
    """From what the filter believes to what is published: calibrated against truth."""

    scale: float = config.key(1.0, low=0.01, high=100)
    shared: float = config.key(0.0, low=0, high=1)
    map: float = config.key(0.0, low=0, high=10)
    focal: float = config.key(0.0, low=0, high=0.1)


@dataclass(frozen=True)
class RecoverySettings:
    """Relocalization from the whole map, without a predicted pose."""

    relocalize: bool = False
    interval_s: float = config.key(0.2, unit="s", low=0, high=60)
    max_ratio: float = config.key(0.85, low=0.1, high=1)
    max_reprojection_px: float = config.key(3.0, unit="px", low=0.5, high=50)
    max_iterations: int = config.key(2000, low=10, high=100000)
    min_inliers: int = config.key(25, low=6, high=1000)
    min_inlier_share: float = config.key(0.25, low=0, high=1)
    min_excess: float = config.key(0.04, low=0, high=1)
    min_significance: float = config.key(6.0, low=0, high=1000)
    min_evenness: float = config.key(4.0, low=0, high=1000)
    min_spread: float = config.key(0.06, low=0, high=0.5)


@dataclass(frozen=True)
class LocalizerSettings:
    """The localizer's configuration file."""

    seed: int = config.key(0, low=0, high=2**31 - 1)
    features: FeatureSettings = config.table(FeatureSettings)
    gate: GateSettings = config.table(GateSettings)
    motion: MotionSettings = config.table(MotionSettings)
    projection: ProjectionSettings = config.table(ProjectionSettings)
    association: AssociationSettings = config.table(AssociationSettings)
    pose: PoseSettings = config.table(PoseSettings)
    tracking: TrackingSettings = config.table(TrackingSettings)
    start: StartSettings = config.table(StartSettings)
    blur: BlurSettings = config.table(BlurSettings)
    state: StateSettings = config.table(StateSettings)
    covariance: CovarianceSettings = config.table(CovarianceSettings)
    recovery: RecoverySettings = config.table(RecoverySettings)


def load_preset(name: str) -> LocalizerSettings:
    """The preset of that name, or a file of one's own; raises `ConfigError`."""
    return config.load(preset_file(name), LocalizerSettings)


def preset_file(name: str) -> Path:
    """Where a preset's settings are; raises `ConfigError` naming the known ones."""
    path = Path(name) if name.endswith(".toml") else _FOLDER / f"{name}.toml"
    if name not in PRESETS and (path.parent == _FOLDER or not path.is_file()):
        known = ", ".join(PRESETS)
        raise ConfigError(f"preset: there is no '{name:.80}' (known: {known}, or a .toml file)")
    return path


def in_units(settings: LocalizerSettings, per_metre: float) -> LocalizerSettings:
    """The same for a map in which a metre is `per_metre` of its units."""
    of = {
        "motion": {
            "translation_density_m2_s3": 2, "walk_translation_m2_s": 2, "swing_arm_m": 1,
        },
        "pose": {"landmark_sigma_m": 1},
        "start": {"sigma_m": 1, "speed_m_s": 1},
        "state": {"good_sigma_m": 1},
    }  # fmt: skip
    tables = {}
    for name, powers in of.items():
        table = getattr(settings, name)
        changes = {key: getattr(table, key) * per_metre**power for key, power in powers.items()}
        tables[name] = replace(table, **changes)
    return replace(settings, **tables)


def for_live(settings: LocalizerSettings) -> LocalizerSettings:
    """The same where frames come at their own pace: no frame waits for a keyframe's features."""
    return replace(settings, tracking=replace(settings.tracking, features_lag_s=0.0))
