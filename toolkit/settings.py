"""Every option of a comparison in one typed record: what it is, its unit, its default and its range.

An estimator finds the record in its ``Setup``; the command line, a TOML file, the manifest, the gate and Monte Carlo
runs carry the same one. A threshold that nobody should have to choose is no setting: it stands in the code, once, with
its source.
"""

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from toolkit.errors import DataError, VislamError, did_you_mean, no_such
from toolkit.inputs import read_text_input

_NS_PER_S = 1_000_000_000
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
Tracks = Literal["auto", "images", "simulated"]
Varied = Literal["noise", "world"]
TrackModel = Literal["white", "correlated", "fitted"]
Scalar = bool | int | float | str


class SettingsError(VislamError):
    """A setting that does not exist or has a value out of its range."""

    exit_status: ClassVar[int] = 2


PolicyName = Literal["robust", "gate", "none", "classic"]
HuberThreshold = Annotated[float, Meta(gt=0.0, extra={"unit": "sigma"})] | None


class Outliers(Struct, frozen=True, forbid_unknown_fields=True):
    """What every estimator does about measurements that disagree with it: a named policy and what it consists of.

    A threshold in sigma is a length of three whitened residuals; a track of more degrees of freedom has the one that is
    exceeded as often. None is no gate, no loss.
    """

    policy: Annotated[
        PolicyName, Meta(description="the policy all of these are taken from, but for what is set by itself")
    ] = "classic"
    gate_probability: Annotated[
        Probability | None, Meta(description="chi-square probability below which a measurement is accepted")
    ] = 0.95
    smoother_gate_factor: Annotated[
        float, Meta(ge=1.0, description="the incremental smoothers' gate, as a multiple of the filters'")
    ] = 4.0
    joint_huber: Annotated[
        HuberThreshold, Meta(description="Huber threshold of the joint and the windowed filters")
    ] = None
    filter_huber: Annotated[HuberThreshold, Meta(description="Huber threshold of the decoupled filters")] = 1.5
    smoother_huber: Annotated[HuberThreshold, Meta(description="Huber threshold of the incremental smoothers")] = (
        2.7954834829151074  # a 95 % gate of three degrees of freedom, as a length
    )
    batch_huber: Annotated[HuberThreshold, Meta(description="Huber threshold of batch's first solve")] = 1.5
    batch_cauchy: Annotated[HuberThreshold, Meta(description="Cauchy scale of batch's second solve")] = 2.0
    batch_cut_probability: Annotated[
        Probability | None, Meta(description="probability below which batch's last solve leaves a sighting out")
    ] = 1e-3
    batch_last_huber: Annotated[HuberThreshold, Meta(description="Huber threshold of batch's last solve")] = None


def _alike(policy: PolicyName, gate_probability: float | None, huber: float | None) -> Outliers:
    """Return a policy with one gate and one loss for every estimator."""
    return Outliers(
        policy=policy,
        gate_probability=gate_probability,
        smoother_gate_factor=1.0,
        joint_huber=huber,
        filter_huber=huber,
        smoother_huber=huber,
        batch_huber=1.5 if gate_probability else huber,
        batch_cauchy=2.0 if gate_probability else None,
        batch_cut_probability=1.0 - gate_probability if gate_probability else None,
        # Beyond the cut there is nothing to hold, and a loss would weigh sound sightings down.
        batch_last_huber=None,
    )


POLICIES: Mapping[PolicyName, Outliers] = {
    "robust": _alike("robust", 0.999, 2.7954834829151074),
    "gate": _alike("gate", 0.999, None),
    "none": _alike("none", None, None),
    "classic": Outliers(),
}


# Until it leaves the window or ends, a track does not correct: a longer window sees a point from further apart, and
# carries the newest pose further by the measured motion alone. An IMU bears that for a second, a noisy twist does not.
_LAG_WITH_IMU_S, _LAG_S = 1.2, 0.6


class Window(Struct, frozen=True, forbid_unknown_fields=True):
    """How much of the past a windowed estimator keeps, filter or smoother."""

    lag_s: (
        Annotated[
            float,
            Meta(
                gt=0.0,
                le=3600.0,
                description="window of the windowed filters and smoothers",
                extra={"unit": "s", "none": f"{_LAG_WITH_IMU_S:g} with an IMU, else {_LAG_S:g}"},
            ),
        ]
        | None
    ) = None
    most_states: Annotated[
        int, Meta(ge=2, le=10_000, description="states in the window at most; of more frames they are thinned evenly")
    ] = 30
    landmarks: Annotated[
        int, Meta(ge=0, le=500, description="landmarks msckf-slam keeps in its state for as long as they are seen")
    ] = 50

    def seconds(self, motion_kind: str) -> float:
        """Return how long the window is for a kind of motion: "imu", "twist" or "none"."""
        if self.lag_s is not None:
            return self.lag_s
        return _LAG_WITH_IMU_S if motion_kind == "imu" else _LAG_S

    def interval(self, since_ns: int, motion_kind: str) -> int:
        """Return which interval of time an instant after the first frame is in; of each one frame has a state.

        They are as long as the window never holds more than its most.
        """
        return int(since_ns * (self.most_states - 1) // round(self.seconds(motion_kind) * _NS_PER_S))


class Noise(Struct, frozen=True, forbid_unknown_fields=True):
    """The noise every estimator assumes; by default what the recording states or its samples show."""

    pixel_sigma_px: (
        Annotated[
            float,
            Meta(
                gt=0.0,
                le=100.0,
                description="standard deviation of uL and uR; v in proportion",
                extra={"unit": "px", "none": "the recording's"},
            ),
        ]
        | None
    ) = None
    motion_scale: Annotated[
        float, Meta(gt=0.0, le=1e3, description="factor on the white-noise densities of the motion samples")
    ] = 1.0
    tracks: Annotated[
        TrackModel,
        Meta(description="errors of a track's sightings: each by itself, a stated walk and offset, or fitted"),
    ] = "white"
    track_white_px: Annotated[
        float,
        Meta(gt=0.0, le=100.0, description="correlated: white part, in column and row", extra={"unit": "px"}),
    ] = 0.03
    track_walk_px: Annotated[
        float, Meta(ge=0.0, le=100.0, description="correlated: walk per root frame", extra={"unit": "px"})
    ] = 0.13
    track_offset_px: Annotated[
        float, Meta(ge=0.0, le=100.0, description="correlated: offset of a track's disparity", extra={"unit": "px"})
    ] = 0.7
    track_fit_s: (
        Annotated[
            float,
            Meta(
                gt=0.0,
                le=86400.0,
                description="fitted: how much of the beginning, so that later causal answers rest on the past",
                extra={"unit": "s", "none": "all of it"},
            ),
        ]
        | None
    ) = None


class Metrics(Struct, frozen=True, forbid_unknown_fields=True):
    """Metrics that take long and are computed on request alone."""

    bound: Annotated[
        bool, Meta(description="the Cramér-Rao bound and what each estimator loses against it, on simulations")
    ] = False

    def requested(self) -> tuple[str, ...]:
        """Return the names of those that are asked for."""
        return tuple(name for name in self.__struct_fields__ if getattr(self, name))


class Frontend(Struct, frozen=True, forbid_unknown_fields=True):
    """How stereo tracks are made of images; the same tracks for every estimator."""

    tracks: Annotated[
        Tracks,
        Meta(description="where a recording with images has its tracks from; auto: images, where nearly all are there"),
    ] = "auto"
    topics: Annotated[
        str | None,
        Meta(description="of a bag, as in left=/cam0/image_raw,imu=/imu0; what is not said is guessed from names"),
    ] = None
    max_tracks: Annotated[int, Meta(ge=20, le=2000, description="stereo tracks a frame at most")] = 200
    spacing_px: Annotated[
        float,
        Meta(ge=3.0, le=200.0, description="least distance of two tracks in the left image", extra={"unit": "px"}),
    ] = 12.0
    window_px: Annotated[
        int, Meta(ge=7, le=63, description="side of the window that KLT compares", extra={"unit": "px"})
    ] = 15
    levels: Annotated[int, Meta(ge=0, le=8, description="halvings of the image in KLT's pyramid")] = 3
    nearest_m: Annotated[
        float, Meta(gt=0.0, le=100.0, description="depth of the nearest point looked for", extra={"unit": "m"})
    ] = 0.5
    forward_backward_px: Annotated[
        float,
        Meta(
            gt=0.0, le=10.0, description="how far KLT there and back may end from where it began", extra={"unit": "px"}
        ),
    ] = 0.3
    epipolar_px: Annotated[
        float, Meta(gt=0.0, le=20.0, description="how far the rows of left and right may differ", extra={"unit": "px"})
    ] = 1.5
    ransac_px: Annotated[
        float,
        Meta(gt=0.0, le=20.0, description="distance from the motion most tracks agree on", extra={"unit": "px"}),
    ] = 2.0
    patch_px: Annotated[
        float,
        Meta(
            gt=0.0, le=20.0, description="how far a track may be from where its first patch fits", extra={"unit": "px"}
        ),
    ] = 1.5
    patch_correlation: Annotated[
        float, Meta(gt=0.0, lt=1.0, description="least correlation with the track's first patch")
    ] = 0.8


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole record, by section. ``estimators`` holds options of single estimators by name, as they define them."""

    outliers: Outliers = Outliers()
    window: Window = Window()
    noise: Noise = Noise()
    metrics: Metrics = Metrics()
    frontend: Frontend = Frontend()
    start: Annotated[
        Literal["measurements", "truth"], Meta(description="where the first state comes from; the truth is labelled")
    ] = "measurements"
    card: Annotated[
        bool, Meta(description="in the report, what the recording's tracks are like; takes some seconds")
    ] = False
    first_seed: Annotated[int, Meta(ge=0, description="seed of simulated sequences, the first of several")] = 0
    seeds: Annotated[
        int, Meta(ge=1, le=100_000, description="how many seeds a simulated sequence is repeated over")
    ] = 1
    vary: Annotated[
        Varied, Meta(description="what a seed draws of a simulation: the noise, or trajectory and landmarks as well")
    ] = "noise"
    estimators: dict[str, dict[str, Scalar]] = {}

    def options_of(self, estimator: str) -> Mapping[str, Scalar]:
        """Return the options set for one estimator alone."""
        return self.estimators.get(estimator, {})


DEFAULTS = Settings()
_POLICY = "outliers.policy"


class Described(NamedTuple):
    """One setting as documentation shows it: key, unit, default, range in words, what it is."""

    key: str
    unit: str
    default: str
    range: str
    meaning: str


def settings_of(given: Mapping[str, Any], place: str) -> Settings:
    """Return the record of nested values, the defaults where nothing is given.

    Raises SettingsError for a key that does not exist, naming the nearest that does, and for a value of another type
    or out of range; ``place`` says where the values come from.
    """
    _check_keys(given, Settings, "", place)
    try:
        return msgspec.convert(_with_policy(given, place), Settings)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{place}: {_in_words(str(error))}") from error


def _with_policy(given: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return nested values with what a named outlier policy consists of, where they do not say otherwise."""
    values, outliers = dict(given), given.get("outliers")
    if isinstance(outliers, Mapping) and "policy" in outliers:
        policy = outliers["policy"]
        if policy not in POLICIES:
            raise SettingsError(f"{place}: {no_such('outlier policy', str(policy), POLICIES)}")
        values["outliers"] = {**msgspec.to_builtins(POLICIES[policy]), **outliers}
    return values


def outliers_in_words(outliers: Outliers) -> str:
    """Return the name of an outlier policy, and what was set by itself."""
    named = msgspec.to_builtins(POLICIES[outliers.policy])
    changed = {key: value for key, value in msgspec.to_builtins(outliers).items() if value != named[key]}
    return f"{outliers.policy}{''.join(f', {key} {value}' for key, value in changed.items())}"


def read_toml(path: Path) -> dict[str, Any]:
    """Return the nested values of a TOML file; raise SettingsError where it cannot be read."""
    try:
        return tomllib.loads(read_text_input(path, "settings are TOML"))
    except DataError as error:
        raise SettingsError(str(error)) from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SettingsError(f"{path}: is not TOML ({error})") from error


def with_assignments(given: Mapping[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return nested values with ``section.key=value`` put in, the value as TOML writes it or a bare word."""
    result: dict[str, Any] = {key: dict(v) if isinstance(v, Mapping) else v for key, v in given.items()}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise SettingsError(f"--set takes KEY=VALUE, as in window.lag_s=3, not {text!r}")
        *sections, name = key.strip().split(".")
        at = result
        for section in sections:
            at = at.setdefault(section, {})
            if not isinstance(at, dict):
                raise SettingsError(f"--set {text}: {section} is a value and has no keys of its own")
        at[name] = _value(value.strip())
        if key.strip() == _POLICY:
            # A policy is named whole: what was set of another is no part of it.
            result["outliers"] = {"policy": at[name]}
    return result


def as_values(settings: Settings) -> dict[str, Any]:
    """Return the whole record as nested values, for a manifest."""
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


def describe() -> tuple[Described, ...]:
    """Return every setting, in the order of the record."""
    return tuple(_described(Settings, ""))


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_keys(given: Mapping[str, Any], record: type[Struct], prefix: str, place: str) -> None:
    hints = get_type_hints(record)
    for key, value in given.items():
        if key not in hints:
            known = [described.key for described in describe()] + ["estimators"]
            raise SettingsError(f"{place}: there is no setting {prefix}{key}{did_you_mean(prefix + key, known)}")
        if isinstance(hints[key], type) and issubclass(hints[key], Struct) and isinstance(value, Mapping):
            _check_keys(value, hints[key], f"{key}.", place)


def _in_words(message: str) -> str:
    """Return what msgspec says of a value, the setting by its own name first."""
    what, _, where = message.partition(" - at `$.")
    return f"{where.rstrip('`')}: {what[0].lower()}{what[1:]}" if where else what


def _described(record: type[Struct], prefix: str) -> Iterator[Described]:
    hints = get_type_hints(record, include_extras=True)
    for field in msgspec.structs.fields(record):
        hint = hints[field.name]
        if isinstance(hint, type) and issubclass(hint, Struct):
            yield from _described(hint, f"{field.name}.")
        elif field.name != "estimators":
            yield _one(f"{prefix}{field.name}", hint, field.default)


def _one(key: str, hint: Any, default: Any) -> Described:
    metas = list(_metas(hint))
    extra = {name: text for meta in metas for name, text in (meta.extra or {}).items()}
    bounds = {name: getattr(meta, name) for meta in metas for name in _BOUNDS if getattr(meta, name) is not None}
    words = [f"{_BOUNDS[name]} {bound:g}" for name, bound in bounds.items()]
    words += [" or ".join(map(str, get_args(part))) for part in _parts(hint) if get_origin(part) is Literal]
    meaning = next(meta.description for meta in metas if meta.description)
    shown = extra.get("none", "none") if default is None else _shown(default)
    return Described(key, extra.get("unit", ""), shown, ", ".join(words), meaning)


_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def _shown(default: Any) -> str:
    return f"{default:.4g}" if isinstance(default, float) else str(default)


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type annotation and all it is made of."""
    yield hint
    for part in get_args(hint):
        if not isinstance(part, Meta):
            yield from _parts(part)


def _metas(hint: Any) -> Iterator[Meta]:
    for part in _parts(hint):
        yield from (meta for meta in getattr(part, "__metadata__", ()) if isinstance(meta, Meta))
