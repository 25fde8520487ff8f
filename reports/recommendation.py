"""What the run recommends, and how firmly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from reports import number_text
from reports.run_folder import Gain, RunFolder, Timed
from vtfs.parameters import PARAMETERS, TECHNIQUES, Value, default_value

CLAIM = "for this JAX implementation on this device; nothing is rasterised: frame times start at view samples"


@dataclass(frozen=True)
class Setting:
    """A parameter of a configuration beside its default (None where the parameter is unknown here)."""

    name: str
    value: Value
    default: Value | None

    @property
    def changed(self) -> bool:
        return self.default is not None and self.value != self.default


@dataclass(frozen=True)
class Recommendation:
    """The sentence at the top of the report, in parts.

    - `verdict`: `tuned`: use `chosen`. `keep_default`: what was found is not faster for certain, so `chosen`
      is a default and `fastest` what was found. `none`: nothing was timed.
    - `gains`: of what was found, each with what it is over; first the one that decides.
    - `failures`: what went wrong how often, most often first.
    """

    verdict: Literal["tuned", "keep_default", "none"]
    chosen: Timed | None
    fastest: Timed | None
    gains: tuple[tuple[Gain, str], ...]
    settings: tuple[Setting, ...]
    failures: tuple[tuple[str, int], ...]
    claim: str

    @property
    def changed(self) -> tuple[Setting, ...]:
        return tuple(setting for setting in self.settings if setting.changed)

    @property
    def unchanged(self) -> tuple[Setting, ...]:
        return tuple(setting for setting in self.settings if not setting.changed)

    @property
    def has_error(self) -> bool:
        """True where the image is not that of the reference, which the sentence must then say."""
        return (
            self.chosen is not None and self.chosen.error is not None and self.chosen.error >= number_text.EXACT_BELOW
        )


@dataclass(frozen=True)
class Bar:
    """One of the times that stand beside the sentence; `share` is its length in percent of the longest."""

    label: str
    timed: Timed
    share: float
    is_chosen: bool


def recommend(run: RunFolder) -> Recommendation:
    """The recommendation that the measured gains allow.

    A gain counts where its 95 % interval lies above 1, over the technique's own default and over the
    fastest of all defaults. Otherwise tuning has not paid, and the fastest default is the honest answer.
    """
    verdict, chosen = _verdict(run)
    outcomes = Counter(line.outcome for line in run.measurements if line.outcome != "timed")
    return Recommendation(
        verdict=verdict,
        chosen=chosen,
        fastest=run.best,
        gains=_gains(run),
        settings=settings(chosen.technique, chosen.params) if chosen else (),
        failures=tuple((outcome.replace("_", " "), n) for outcome, n in outcomes.most_common()),
        claim=str(run.quoted("claim") or CLAIM).rstrip("."),
    )


def _verdict(run: RunFolder) -> tuple[Literal["tuned", "keep_default", "none"], Timed | None]:
    if run.best is None:
        return "none", None
    default = run.fastest_default or run.default
    if default is not None and any(gain.inside_noise for gain, _ in _gains(run)):
        return "keep_default", default
    return "tuned", run.best


def _gains(run: RunFolder) -> tuple[tuple[Gain, str], ...]:
    """One inside the noise first, else the one over the technique's own default."""
    own, fastest = run.gain_over_default, run.gain_over_fastest_default
    technique = run.fastest_default.technique if run.fastest_default else ""
    gains = []
    if own and run.best and technique == run.best.technique:
        gains = [(own, "its defaults, the fastest of all defaults")]
    else:
        gains += [(own, "its own defaults")] if own else []
        gains += [(fastest, f"the fastest default{', that of ' + technique if technique else ''}")] if fastest else []
    return tuple(sorted(gains, key=lambda gain: not gain[0].inside_noise))


def comparison(run: RunFolder) -> tuple[Bar, ...]:
    """The technique's default, the fastest default and the best, each where it is known and not the same as another."""
    chosen = _verdict(run)[1]
    rows: list[tuple[str, Timed]] = []
    for label, timed in (("default", run.default), ("fastest default", run.fastest_default), ("best found", run.best)):
        if timed is not None and not any(timed.is_configuration(other.technique, other.params) for _, other in rows):
            rows.append((label, timed))
    longest_ms = max((timed.time_ms for _, timed in rows), default=0.0) or 1.0
    return tuple(
        Bar(
            label,
            timed,
            share=100 * timed.time_ms / longest_ms,
            is_chosen=chosen is not None and timed.is_configuration(chosen.technique, chosen.params),
        )
        for label, timed in rows
    )


def settings(technique: str, params: Mapping[str, Value]) -> tuple[Setting, ...]:
    """Every parameter with its default, in the order in which the technique lists them."""
    order = [name for name in TECHNIQUES.get(technique, ()) if name in params]
    order += [name for name in params if name not in order]
    return tuple(
        Setting(name, params[name], default_value(technique, name) if name in PARAMETERS else None) for name in order
    )


def setting_text(technique: str, params: Mapping[str, Value]) -> str:
    """A configuration in one line: what is not at its default."""
    changed = [
        f"{setting.name}={number_text.setting(setting.value)}"
        for setting in settings(technique, params)
        if setting.changed
    ]
    return " ".join([technique, *changed]) if changed else f"{technique}, defaults"
