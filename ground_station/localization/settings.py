"""Every constant of the localizer, with unit, range and default, and the presets that ship."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ground_station.features.settings import FeatureSettings
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

_FOLDER = Path(__file__).with_name("presets")
PRESETS = tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))
"""By name; each is a file of its own."""


@dataclass(frozen=True)
class GateSettings:
    """Which frames are not worth solving."""

    min_entropy_bits: float = config.key(
        0.0, "frames of less luma entropy are skipped; 0: none", unit="bits", low=0, high=8
    )
    min_contrast: float = config.key(
        0.0,
        "frames whose brightest and darkest 8x8 px differ by less are skipped; 0: none",
        unit="grey levels",
        low=0,
        high=255,
    )


@dataclass(frozen=True)
class MotionSettings:
    """How the next frame's pose is predicted."""

    model: str = config.key(
        "constant_velocity",
        "static: where the last solved frame was; blimp: with drag and swing",
        choices=["static", "constant_velocity", "blimp"],
    )
    max_step_s: float = config.key(
        1.0, "two solved frames further apart give no velocity", unit="s", low=0.001, high=10
    )
    coast_s: float = config.key(
        0.5,
        "the velocity is carried on for this long, then the pose is held",
        unit="s",
        low=0,
        high=10,
    )
    rotation_density_rad2_s3: float = config.key(
        1e-4, "spectral density of a quiet flight's angular acceleration, each axis",
        unit="rad2/s3", low=1e-5, high=1e3,
    )  # fmt: skip
    translation_density_m2_s3: float = config.key(
        1e-3, "spectral density of a quiet flight's acceleration, each axis",
        unit="m2/s3", low=1e-5, high=1e3,
    )  # fmt: skip
    density_limit: float = config.key(
        1e5, "innovations raise the densities up to this often; 1: they stay", low=1, high=1e9
    )
    density_time_s: float = config.key(
        0.3, "time in which the densities follow the innovations", unit="s", low=0.03, high=60
    )
    walk_rotation_rad2_s: float = config.key(
        0.02, "static: spectral density of the pose's random walk, each axis",
        unit="rad2/s", low=1e-9, high=1e3,
    )  # fmt: skip
    walk_translation_m2_s: float = config.key(
        0.02, "static: spectral density of the pose's random walk, each axis",
        unit="m2/s", low=1e-9, high=1e3,
    )  # fmt: skip
    drag_time_s: float = config.key(
        20.0, "blimp: its speed falls to 1/e in this time", unit="s", low=0.1, high=1000
    )
    pitch_period_s: float = config.key(
        3.4, "blimp: period of its swing about the camera's x axis", unit="s", low=0.2, high=60
    )
    roll_period_s: float = config.key(
        1.5, "blimp: period of its swing about the axis across", unit="s", low=0.2, high=60
    )
    swing_damping: float = config.key(0.12, "blimp: damping ratio of the swing", low=0, high=0.99)
    swing_arm_m: float = config.key(
        0.42, "blimp: the camera is this far below the turning point", unit="m", low=0, high=10
    )
    rest_time_s: float = config.key(
        20.0, "blimp: time in which its direction of rest is learned", unit="s", low=0.1, high=1000
    )
    smoother_lag_s: float = config.key(
        1.0, "smoothed poses use the frames of this long after them", unit="s", low=0.1, high=5
    )


@dataclass(frozen=True)
class ProjectionSettings:
    """Which landmarks are looked for."""

    viewing_cone: bool = config.key(
        False, "drop landmarks seen from a direction from which no keyframe saw them"
    )
    cone_margin_deg: float = config.key(
        30.0, "added to the cone's half angle", unit="deg", low=0, high=180
    )
    max_distance_ratio: float = config.key(
        2.5, "how much nearer or farther than any keyframe was, with the cone", low=1, high=100
    )
    covisibility: bool = config.key(
        False, "drop landmarks that no keyframe near or covisible with the last frame's saw"
    )


@dataclass(frozen=True)
class AssociationSettings:
    """Which feature is which landmark."""

    radius_px: float = config.key(
        40.0,
        "a feature looks for landmarks this near, in a picture 640 px wide; a share of its width",
        unit="px",
        low=1,
        high=500,
    )
    max_descriptor_distance: float = config.key(
        0.7, "largest L2 distance of unit descriptors", low=0, high=2
    )
    scale_distances: bool = config.key(
        False,
        "distances are first divided by how much farther the model's are than RootSIFT's",
    )
    max_ratio: float = config.key(
        1.0, "nearest over second nearest distance within the radius; 1: no test", low=0.1, high=1
    )
    max_chance_share: float = config.key(
        1.0,
        "of the pairs; the farthest descriptors are left out until chance can have made no more",
        low=0.001, high=1,
    )  # fmt: skip
    refine_radius_px: float = config.key(
        0.0, "associate again this near after a first solution; 0: no", unit="px", low=0, high=500
    )


@dataclass(frozen=True)
class PoseSettings:
    """How a pose is solved from its observations, and when it is believed."""

    solver: str = config.key(
        "graph",
        "graph: GTSAM factors on pose and landmarks; direct: landmarks marginalised, vectorised; "
        "rolling: pose and velocity with a prediction's covariance, rows at their own times",
        choices=["graph", "direct", "rolling"],
    )
    sigma_px: float = config.key(
        5.0, "standard deviation of an observation", unit="px", low=0.1, high=50
    )
    huber_k: float = config.key(
        1.345, "Huber's threshold in standard deviations", low=0.1, high=100
    )
    landmark_sigma_m: float = config.key(
        0.01, "standard deviation of a landmark's position", unit="m", low=1e-6, high=10
    )
    max_iterations: int = config.key(
        30, "Gauss-Newton steps before it is a failure", low=1, high=500
    )
    max_observations: int = config.key(
        400, "best observations (smallest descriptor distance) that are solved", low=6, high=10000
    )
    min_observations: int = config.key(12, "fewer associations are not solved", low=4, high=1000)
    inlier_px: float = config.key(
        12.0, "an observation with a smaller residual is an inlier", unit="px", low=0.5, high=100
    )
    min_inliers: int = config.key(12, "a pose with fewer is not believed", low=4, high=1000)
    min_inlier_share: float = config.key(
        0.35, "a pose with a smaller share of inliers is not believed", low=0, high=1
    )
    reject_outliers: bool = config.key(False, "solve once more from the inliers alone")
    rolling_shutter: bool = config.key(
        False, "each row at its own time, by the camera's readout time; rolling solver only"
    )


@dataclass(frozen=True)
class TrackingSettings:
    """How matched points are followed between the frames that are described."""

    enabled: bool = config.key(
        False, "follow a keyframe's points by KLT; false: features of every frame"
    )
    max_points: int = config.key(300, "points of a keyframe that are followed", low=12, high=2000)
    window_px: int = config.key(21, "side of KLT's window", unit="px", low=5, high=63)
    levels: int = config.key(3, "levels of KLT's pyramid", low=1, high=6)
    max_return_px: float = config.key(
        0.7, "a point that misses its start by more, followed back, is dropped",
        unit="px", low=0.05, high=10,
    )  # fmt: skip
    max_difference: float = config.key(
        0.5, "a point whose surroundings differ by more of their contrast in the mean is another",
        low=0, high=8,
    )  # fmt: skip
    sigma_px: float = config.key(
        3.0,
        "standard deviation of a followed point, common errors of its keyframe included",
        unit="px",
        low=0.1,
        high=50,
    )
    min_inliers: int = config.key(
        10, "a followed frame with fewer is not believed", low=6, high=1000
    )
    sure_distance: float = config.key(
        0.5, "descriptor distance up to which a keyframe's points are followed", low=0, high=2
    )
    sure_points: int = config.key(
        100, "farther ones only where those are fewer, up to so many", low=0, high=2000
    )
    doubt_distance: float = config.key(
        0.3, "descriptor distance from which a point's sigma grows with its square",
        low=0.01, high=2,
    )  # fmt: skip
    min_significance: float = config.key(
        7.0, "of a keyframe: standard deviations by which more landmarks are seen than by chance",
        low=0, high=1000,
    )  # fmt: skip
    min_found_share: float = config.key(
        0.1, "of a keyframe's points in view; a frame that shows fewer is not believed",
        low=0, high=1,
    )  # fmt: skip
    max_chance_share: float = config.key(
        1.0, "association's, of a keyframe: its pose is known, and few chance pairs can turn it",
        low=0.001, high=1,
    )  # fmt: skip
    keyframe_min_points: int = config.key(20, "a keyframe with fewer is none", low=6, high=1000)
    keyframe_parallax_px: float = config.key(
        100.0, "a keyframe whose points moved by this in the median is replaced", unit="px",
        low=1, high=10000,
    )  # fmt: skip
    keyframe_interval_s: float = config.key(
        0.2, "a keyframe as old as this is replaced", unit="s", low=0, high=10
    )
    keyframe_min_share: float = config.key(
        0.6, "and one of which a smaller share of points is found again", low=0, high=1
    )
    describe_gap_s: float = config.key(
        0.09,
        "a frame that comes this long after the one before is described itself: there is time",
        unit="s", low=0, high=1000,
    )  # fmt: skip
    features_lag_s: float = config.key(
        0.19, "time after which a keyframe's features land, waited for; 0: when ready", unit="s",
        low=0, high=10,
    )  # fmt: skip
    hurry_px_s: float = config.key(
        150.0, "points faster than this need their next keyframe sooner", unit="px/s",
        low=0, high=1e5,
    )  # fmt: skip
    hurried_lag_s: float = config.key(
        0.12, "and that keyframe's features land after so long at most", unit="s", low=0, high=10
    )
    search_lag_s: float = config.key(
        0.19, "a search's result lands after so long at most", unit="s", low=0, high=10
    )


@dataclass(frozen=True)
class StartSettings:
    """What is believed of a pose that did not come from the frame before."""

    sigma_m: float = config.key(
        0.3, "standard deviation of its position, an axis", unit="m", low=0.001, high=10
    )
    sigma_deg: float = config.key(
        5.0, "and of its direction, an axis", unit="deg", low=0.01, high=90
    )
    speed_m_s: float = config.key(
        1.5, "standard deviation of the velocity, an axis", unit="m/s", low=0.001, high=50
    )
    turn_deg_s: float = config.key(
        40.0, "standard deviation of the turn rate, an axis", unit="deg/s", low=0.1, high=1000
    )


@dataclass(frozen=True)
class BlurSettings:
    """How much less an observation weighs in a blurred frame."""

    enabled: bool = config.key(
        False, "expect blur from speed and exposure; false: all frames weigh alike"
    )
    sigma_per_px: float = config.key(
        0.12, "of an observation, added in quadrature for each pixel of blur", low=0, high=2
    )
    plain_sharpness: float = config.key(
        0.75, "less gradient than this share of the recent frames' is blur, too", low=0.05, high=1
    )
    recent_frames: int = config.key(30, "frames whose gradients are compared", low=1, high=1000)


@dataclass(frozen=True)
class StateSettings:
    """When a localizer calls itself degraded or lost."""

    lost_after_s: float = config.key(
        0.0,
        "without a solved frame for longer: LOST, before that DEGRADED",
        unit="s",
        low=0,
        high=60,
    )
    confirm_frames: int = config.key(
        1,
        "frames that must agree with a relocalization, by other features, before TRACKING",
        low=0,
        high=100,
    )
    sure_significance: float = config.key(
        1e9, "and none, where it shows more landmarks than by chance by so many deviations",
        low=0, high=1e9,
    )  # fmt: skip
    recover_frames: int = config.key(
        0, "good frames in a row from DEGRADED back to TRACKING", low=0, high=100
    )
    good_inliers: int = config.key(25, "fewer inliers: DEGRADED", low=4, high=1000)
    good_inlier_share: float = config.key(
        0.0, "a smaller share of inliers: DEGRADED", low=0, high=1
    )
    good_spread: float = config.key(
        0.06, "inliers' spread (RMS from their centre over the image's diagonal) below: DEGRADED",
        low=0, high=0.5,
    )  # fmt: skip
    good_sigma_m: float = config.key(
        1000.0, "standard deviation of the position above: DEGRADED", unit="m", low=0, high=1000
    )
    good_sigma_deg: float = config.key(
        360.0, "standard deviation of the direction above: DEGRADED", unit="deg", low=0, high=360
    )
    good_residual_px: float = config.key(
        1000.0, "inliers' RMS residual above: DEGRADED", unit="px", low=0, high=1000
    )
    good_sharpness: float = config.key(
        0.0, "sharpness over that of the frames before below: DEGRADED", low=0, high=1
    )
    max_innovation: float = config.key(
        1e9, "squared Mahalanobis distance from the prediction (12 degrees of freedom) above: "
        "DEGRADED", low=0, high=1e9,
    )  # fmt: skip
    max_support_s: float = config.key(
        1000.0,
        "a keyframe older than this that frames since did not confirm: DEGRADED",
        unit="s",
        low=0,
        high=1000,
    )


@dataclass(frozen=True)
class CovarianceSettings:
    """From what the filter believes to what is published: calibrated against truth."""

    scale: float = config.key(1.0, "standard deviations are multiplied by it", low=0.01, high=100)
    shared: float = config.key(
        0.0, "share of the deviations by a frame's observations that all frames have in common",
        low=0, high=10,
    )  # fmt: skip
    map: float = config.key(
        0.0, "share of the map's own deviations, by its registration in map.toml, that is added",
        low=0, high=10,
    )  # fmt: skip


@dataclass(frozen=True)
class RecoverySettings:
    """Relocalization from the whole map, without a predicted pose."""

    relocalize: bool = config.key(False, "when INITIALIZING without a first pose, and when LOST")
    interval_s: float = config.key(
        0.2, "shortest time between two attempts", unit="s", low=0, high=60
    )
    max_ratio: float = config.key(
        0.85, "nearest over second nearest descriptor distance", low=0.1, high=1
    )
    max_reprojection_px: float = config.key(
        3.0, "RANSAC's inlier threshold", unit="px", low=0.5, high=50
    )
    max_iterations: int = config.key(2000, "RANSAC's hypotheses", low=10, high=100000)
    min_inliers: int = config.key(25, "a relocalization with fewer is refused", low=6, high=1000)
    min_inlier_share: float = config.key(
        0.25, "of the matches; a smaller share is refused", low=0, high=1
    )
    min_excess: float = config.key(
        0.04, "share of the landmarks that should be seen and are, beyond chance", low=0, high=1
    )
    min_significance: float = config.key(
        9.0, "and that excess in standard deviations of chance", low=0, high=1000
    )
    min_spread: float = config.key(
        0.06, "inliers' spread as in the state's; a smaller one is refused", low=0, high=0.5
    )


@dataclass(frozen=True)
class LocalizerSettings:
    """The localizer's configuration file."""

    seed: int = config.key(0, "of RANSAC's draws", low=0, high=2**31 - 1)
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
