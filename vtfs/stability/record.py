"""`stability.json`: what every method did on every rung, written anew after each rung so that a kill loses none."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from vtfs.files import write_atomically
from vtfs.input_error import InputError

SCHEMA = 1
FILE = "stability.json"

Kind = Literal["shadow", "light"]


@dataclass(frozen=True)
class Verdict:
    """One method on one rung.

    - `wrong`: samples with false light or false shadow outside the bands; pairs of a light and a sample that it
      reaches that were missed. `excused`: samples that differ within the bands.
    - `share`: `wrong` of what was tested. `listed_ratio`: pairs of a cell and a light on the lists over those that a
      sample proves, for light tests.
    - `refused`: why the method has no answer, or nothing.
    """

    wrong: int = 0
    excused: int = 0
    false_light: int = 0
    false_shadow: int = 0
    share: float = 0.0
    listed_ratio: float | None = None
    refused: str = ""


@dataclass(frozen=True)
class RungResult:
    """All methods on one rung of a ladder.

    - `tested`: samples, or pairs that must be listed; `lit`, `shadowed`: of the samples, by the reference. A rung whose
      samples are all lit can only show false shadows.
    - `failed`: why the rung could not be run at all, or nothing.
    """

    ladder: str
    title: str
    source: str
    kind: Kind
    label: str
    tested: int
    lit: int
    shadowed: int
    verdicts: dict[str, Verdict]
    failed: str = ""


@dataclass(frozen=True)
class StabilityResult:
    """A whole run, as far as it came.

    - `planned`: rungs that the run has in all.
    """

    scene: dict[str, Any]
    seed: int
    device: str
    versions: dict[str, str]
    planned: int
    wall_s: float
    rungs: tuple[RungResult, ...]

    @property
    def is_complete(self) -> bool:
        return len(self.rungs) >= self.planned

    def as_json(self) -> dict[str, Any]:
        """What says nothing is left out of verdicts: most methods hold on most rungs."""
        record = {"schema": SCHEMA, "complete": self.is_complete, **asdict(self)}
        for rung in record["rungs"]:
            for name, verdict in rung["verdicts"].items():
                rung["verdicts"][name] = {key: value for key, value in verdict.items() if value}
        return record


def write_result(folder: Path, result: StabilityResult) -> Path:
    """**Raises:** `InputError` where the folder cannot be written."""
    path = folder / FILE
    write_atomically(path, json.dumps(result.as_json(), indent=1, allow_nan=False).encode())
    return path


def read_result(folder: Path) -> StabilityResult:
    """**Raises:** `InputError` where the file is missing, damaged, or of another version."""
    path = folder / FILE
    try:
        record = json.loads(path.read_bytes())
        if record["schema"] != SCHEMA:
            raise InputError(f"{path}: `schema` is {record['schema']!r}; this version of vtfs reads {SCHEMA}.")
        fields = {name: value for name, value in record.items() if name not in ("schema", "complete", "rungs")}
        rungs = tuple(
            RungResult(**{**rung, "verdicts": {name: Verdict(**v) for name, v in rung["verdicts"].items()}})
            for rung in record["rungs"]
        )
        return StabilityResult(**fields, rungs=rungs)
    except FileNotFoundError:
        raise InputError(f"{path}: missing; `vtfs stability --out {folder}` writes it.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: damaged ({error}); run `vtfs stability` again.") from None
