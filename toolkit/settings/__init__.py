"""Every option of a comparison in one typed record: what it is, its unit, its default and its range.

An estimator finds the record in its ``Setup``; the command line, a TOML file, the manifest, the gate and Monte Carlo
runs carry the same one. A threshold that no user has to choose is no setting: it is in the code, once, with its source.
Read ``records``; ``reading``, which estimators do not need, converts input to a record and describes each setting.
"""

from toolkit.settings.records import (
    DEFAULTS,
    POLICIES,
    Frontend,
    Metrics,
    Noise,
    Outliers,
    PolicyName,
    Scalar,
    Settings,
    SettingsError,
    Tracks,
    TrackUse,
    Varied,
    Window,
    as_values,
    changes_of,
    outlier_summary,
)

__all__ = [
    "DEFAULTS",
    "POLICIES",
    "Frontend",
    "Metrics",
    "Noise",
    "Outliers",
    "PolicyName",
    "Scalar",
    "Settings",
    "SettingsError",
    "TrackUse",
    "Tracks",
    "Varied",
    "Window",
    "as_values",
    "changes_of",
    "outlier_summary",
]
