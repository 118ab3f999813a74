"""Every option of a comparison in one typed record, section by section: meaning, unit, default and range of each.

An estimator finds the record in its ``Setup``; the command line, a TOML file, the manifest, the gate and Monte Carlo
runs carry the same one. A threshold that no user has to choose is no setting: it is in the code, once, with its source.
``reading``, which estimators do not need, converts input to a record and describes each setting.
"""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta, Struct

from toolkit.errors import VislamError

_NS_PER_S = 1_000_000_000
Tracks = Literal["auto", "images", "simulated"]
Varied = Literal["noise", "world"]
PolicyName = Literal["robust", "gate", "none", "classic"]
Auto = Literal["auto"]
Scalar = bool | int | float | str
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
HuberThreshold = Annotated[float, Meta(ge=1e-3, le=1e6, extra={"unit": "sigma"})]
Pixels = Annotated[float, Meta(gt=0.0, le=20.0)]


class SettingsError(VislamError):
    """A setting that does not exist or has a value out of its range."""

    exit_status: ClassVar[int] = 2


def _about(description: str, unit: str = "", *, none: str = "", **within: float) -> Meta:
    """Return what is told of a setting: what it is, its unit, what None stands for, and its range as Meta has it."""
    extra = {key: text for key, text in {"unit": unit, "none": none}.items() if text}
    bounds: dict[str, Any] = {**within}
    return Meta(description=description, extra=extra, **bounds)


class Outliers(Struct, frozen=True, forbid_unknown_fields=True):
    """What every estimator does about measurements that disagree with it: a named policy and what it consists of.

    A threshold in sigma is a length of three whitened residuals; a track of more degrees of freedom has the one that is
    exceeded as often. None is no gate, no loss.
    """

    policy: Annotated[PolicyName, _about("policy that sets all keys below, except those that are set themselves")] = (
        "robust"
    )
    gate_probability: Annotated[
        Probability | None, _about("chi-square probability below which a measurement is accepted")
    ] = 0.99
    smoother_gate_factor: Annotated[
        float, _about("the incremental smoothers' gate, as a multiple of the filters'", ge=1.0)
    ] = 1.0
    joint_huber: Annotated[HuberThreshold | None, _about("Huber threshold of the joint and the windowed filters")] = 1.5
    filter_huber: Annotated[HuberThreshold | None, _about("Huber threshold of the decoupled filters")] = 1.5
    smoother_huber: Annotated[HuberThreshold | None, _about("Huber threshold of the incremental smoothers")] = 1.5
    batch_huber: Annotated[HuberThreshold | None, _about("Huber threshold of batch's first solve")] = 1.5
    batch_cauchy: Annotated[HuberThreshold | None, _about("Cauchy scale of batch's second solve")] = 2.0
    batch_cut_probability: Annotated[
        Probability | None, _about("probability below which batch's last solve leaves a sighting out")
    ] = 1e-3
    # Beyond the cut no sightings are left to weigh down, and a loss would weigh down sound ones.
    batch_last_huber: Annotated[HuberThreshold | None, _about("Huber threshold of batch's last solve")] = None


POLICIES: Mapping[PolicyName, Outliers] = {
    # One gate and one loss for every estimator.
    "robust": Outliers(),
    "gate": Outliers(policy="gate", joint_huber=None, filter_huber=None, smoother_huber=None),
    "none": Outliers(
        policy="none",
        gate_probability=None,
        joint_huber=None,
        filter_huber=None,
        smoother_huber=None,
        batch_huber=None,
        batch_cauchy=None,
        batch_cut_probability=None,
    ),
    # Each estimator's own, as it was until there was one for all.
    "classic": Outliers(
        policy="classic",
        gate_probability=0.95,
        smoother_gate_factor=4.0,
        joint_huber=None,
        smoother_huber=2.7954834829151074,  # a 95 % gate of three degrees of freedom, as a length
    ),
}


# A track that is longer than the window starts anew, so that a longer window is better where errors of sightings are
# independent; the gain beside an IMU was measured (docs/settings.md). Errors of real tracks are not independent, and
# filters that treat them as white lose accuracy by a longer window on drives with measured twists.
_LAG_WITH_IMU_S, _LAG_S = 2.0, 0.6


class Window(Struct, frozen=True, forbid_unknown_fields=True):
    """How much of the past a windowed estimator keeps, filter or smoother."""

    lag_s: Annotated[
        Annotated[float, Meta(ge=1e-3, le=3600.0)] | None,
        _about(
            "window of the windowed filters and smoothers",
            "s",
            none=f"{_LAG_WITH_IMU_S:g} with an IMU, else {_LAG_S:g}",
        ),
    ] = None
    most_states: Annotated[
        int,
        _about(
            "most states in the window; if there are more frames, states are thinned evenly; 1: the newest alone",
            ge=1,
            le=10_000,
        ),
    ] = 50
    landmarks: Annotated[
        int, _about("landmarks msckf-slam keeps in its state for as long as they are seen", ge=0, le=500)
    ] = 50

    def seconds(self, motion_kind: str) -> float:
        """Return how long the window is for a kind of motion: "imu", "twist" or "none"; 0 for one state."""
        if self.most_states == 1:
            return 0.0
        if self.lag_s is not None:
            return self.lag_s
        return _LAG_WITH_IMU_S if motion_kind == "imu" else _LAG_S

    def interval(self, since_ns: int, motion_kind: str) -> int:
        """Return the number of the interval that a time after the first frame is in; one frame of each has a state.

        Intervals are so long that the window never holds more than its largest number of states. A window of the newest
        state alone moves on with every frame.
        """
        if self.most_states == 1:
            return since_ns
        return int(since_ns * (self.most_states - 1) // round(self.seconds(motion_kind) * _NS_PER_S))


class Noise(Struct, frozen=True, forbid_unknown_fields=True):
    """The noise every estimator assumes; by default what the recording states or its samples show."""

    # Below 1e-5 px, rounding leaves covariances that are not positive definite.
    pixel_sigma_px: Annotated[
        Annotated[float, Meta(ge=1e-3, le=100.0)] | None,
        _about("standard deviation of uL and uR; v in proportion", "px", none="the recording's"),
    ] = None
    track_weight: Annotated[
        Annotated[float, Meta(gt=0.0, le=1.0)] | Auto,
        _about(
            "share of its stated information that a sighting carries, because errors along tracks are correlated; "
            "auto: measured on the recording"
        ),
    ] = "auto"
    motion_scale: Annotated[
        Annotated[float, Meta(ge=1e-6, le=1e3)] | Auto,
        _about("factor on the white-noise densities of the motion samples; auto: measured on the recording, 1 or more"),
    ] = "auto"
    measured_s: Annotated[
        Annotated[float, Meta(ge=1e-6, le=86400.0)] | None,
        _about(
            "length of the beginning on which auto is measured, so that later causal answers use the past only",
            "s",
            none="all of it",
        ),
    ] = None
    bridge_gaps: Annotated[
        bool, _about("where frames have no track in common, measured twists before and after predict the twist, too")
    ] = True
    biases: Annotated[
        Literal["estimated", "fixed"], _about("biases of the motion samples: estimated, or fixed where they start")
    ] = "estimated"


class TrackUse(Struct, frozen=True, forbid_unknown_fields=True):
    """Which of a recording's tracks the estimators work on; those withheld stay as they are."""

    budget: Annotated[
        Annotated[int, Meta(ge=10, le=10_000)] | None,
        _about("most tracks a frame that estimators get, spread over image and depth, the oldest first", none="all"),
    ] = 200


class Metrics(Struct, frozen=True, forbid_unknown_fields=True):
    """Metrics that take long and are computed on request alone."""

    bound: Annotated[bool, _about("the Cramér-Rao bound and what each estimator loses against it, on simulations")] = (
        False
    )

    def requested(self) -> tuple[str, ...]:
        return tuple(name for name in self.__struct_fields__ if getattr(self, name))


class Frontend(Struct, frozen=True, forbid_unknown_fields=True):
    """How stereo tracks are made of images; the same tracks for every estimator."""

    tracks: Annotated[
        Tracks, _about("source of the tracks of a recording with images; auto: the images, if nearly all of them exist")
    ] = "auto"
    topics: Annotated[
        str | None, _about("topics of a bag, as in left=/cam0/image_raw,imu=/imu0; others are guessed from their names")
    ] = None
    max_tracks: Annotated[int, _about("most stereo tracks a frame", ge=20, le=2000)] = 200
    spacing_px: Annotated[float, _about("least distance of two tracks in the left image", "px", ge=3.0, le=200.0)] = (
        12.0
    )
    window_px: Annotated[int, _about("side of the window that KLT compares", "px", ge=7, le=63)] = 15
    levels: Annotated[int, _about("halvings of the image in KLT's pyramid", ge=0, le=8)] = 3
    nearest_m: Annotated[float, _about("smallest depth that is searched", "m", gt=0.0, le=100.0)] = 0.25
    forward_backward_px: Annotated[float, _about("largest forward-backward error of KLT", "px", gt=0.0, le=10.0)] = 0.3
    epipolar_px: Annotated[Pixels, _about("largest difference of left and right rows", "px")] = 1.5
    ransac_px: Annotated[Pixels, _about("largest distance from the common motion of tracks", "px")] = 2.0
    patch_px: Annotated[Pixels, _about("largest distance of a track from the best match of its first patch", "px")] = (
        1.5
    )
    patch_correlation: Annotated[Probability, _about("least correlation with the track's first patch")] = 0.8


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole record, by section. ``estimators`` holds options of single estimators by name, as they define them."""

    outliers: Outliers = Outliers()
    window: Window = Window()
    noise: Noise = Noise()
    tracks: TrackUse = TrackUse()
    metrics: Metrics = Metrics()
    frontend: Frontend = Frontend()
    start: Annotated[
        Literal["measurements", "truth"], _about("source of the first state; a start from the truth is labelled")
    ] = "measurements"
    card: Annotated[bool, _about("describe the recording's tracks in the report; takes some seconds")] = False
    first_seed: Annotated[int, _about("seed of simulated sequences, the first of several", ge=0)] = 0
    seeds: Annotated[int, _about("how many seeds a simulated sequence is repeated over", ge=1, le=100_000)] = 1
    vary: Annotated[
        Varied, _about("what a seed draws of a simulation: the noise, or trajectory and landmarks as well")
    ] = "noise"
    estimators: dict[str, dict[str, Scalar]] = {}

    def options_of(self, estimator: str) -> Mapping[str, Scalar]:
        """Return the options set for one estimator alone."""
        return self.estimators.get(estimator, {})


DEFAULTS = Settings()


def outlier_summary(outliers: Outliers) -> str:
    """Return the name of an outlier policy, and what was set by itself."""
    named = msgspec.to_builtins(POLICIES[outliers.policy])
    changed = {key: value for key, value in msgspec.to_builtins(outliers).items() if value != named[key]}
    return f"{outliers.policy}{''.join(f', {key} {value}' for key, value in changed.items())}"


def as_values(settings: Settings) -> dict[str, Any]:
    values: dict[str, Any] = msgspec.to_builtins(settings)
    return values


def changes_of(settings: Settings) -> dict[str, Any]:
    """Return the nested values in which settings differ from the defaults: what follows when the defaults change."""
    changed: dict[str, Any] = {}
    defaults = as_values(DEFAULTS)
    for key, value in as_values(settings).items():
        section = isinstance(value, dict) and key != "estimators"
        differs = {name: one for name, one in value.items() if one != defaults[key][name]} if section else value
        if differs != ({} if section else defaults[key]):
            changed[key] = differs
    return changed
