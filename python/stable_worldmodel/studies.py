"""Studies: many evaluations with one table (`docs/studies.md`).

    study = swm.studies.run("two-room/colour-wheel", "wheel", small=True, episodes=20)
    study.rows[0]["success.rate"]
    study.column("gap.difference")  # a numpy array, NaN for conditions that are not shifted
    Path("wheel.csv").write_text(study.export("csv"))

A study that was interrupted continues with the same call.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import _engine, _files, _options
from .wm.engine import _command

__all__ = ["Study", "available", "read", "run"]


@dataclass(frozen=True)
class Study:
    """The results of a study, which may still be running.

    Attributes:
        folder: The folder of the study.
        results: The results as `swm study status --json` prints them.
    """

    folder: Path
    results: dict[str, Any]

    @property
    def title(self) -> str:
        """The title."""
        return str(self.results["title"])

    @property
    def is_done(self) -> bool:
        """Whether all cells have results."""
        return bool(self.results["done"] == self.results["cells"])

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A dict for each row of the table, with dots in the names of nested values, such as `success.rate`.

        A study whose cells are no evaluations has the names of its columns.
        """
        if "columns" not in self.results:
            return [_flat(row) for row in self.results["rows"]]
        names = [column["name"] for column in self.results["columns"]]
        return [
            {"cell": row["cell"], self.results["subject"]: row["name"], **dict(zip(names, row["values"], strict=True))}
            for row in self.results["rows"]
        ]

    @property
    def gaps(self) -> list[dict[str, Any]]:
        """The rows that are compared with the first condition."""
        return [row for row in self.rows if row.get("gap.difference") is not None]

    @property
    def families(self) -> list[dict[str, Any]]:
        """The families of gaps: their number, and the smallest difference that they tell apart."""
        return list(self.results.get("families", []))

    @property
    def over_seeds(self) -> list[dict[str, Any]]:
        """Rows that differ in the training seed only, taken together."""
        return list(self.results.get("over_seeds", []))

    def column(self, name: str) -> np.ndarray:
        """The values of all rows under a name of `rows`: numbers with NaN for missing ones, or texts.

        Raises:
            KeyError: If no row has the name.
        """
        rows = self.rows
        if not any(name in row for row in rows):
            known = sorted({key for row in rows for key in row})
            raise KeyError(f"no row has '{name}': the names are {', '.join(known)}")
        values = [row.get(name) for row in rows]
        if any(isinstance(value, str) for value in values):
            return np.array(["" if value is None else str(value) for value in values])
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

    def export(self, format: str = "csv") -> str:
        """The table as text: `csv`, `csv-seeds`, `latex` or `markdown`."""
        return _engine.study_export(str(self.folder), format)

    def report(self, output: str | os.PathLike[str] | None = None) -> Path:
        """Writes one HTML page with figures and tables beside it, and returns its path.

        Raises:
            ValueError: If the folder is a URI.
        """
        folder = self.folder / "report" if output is None else _files.local("output", output)
        _command(["swm", "study", "report", str(self.folder), "--output", str(folder)])
        return folder / "index.html"


def available() -> list[dict[str, str]]:
    """The `name`, `title` and `question` of every study that comes with the package."""
    return list(json.loads(_engine.studies()))


def read(folder: str | os.PathLike[str]) -> Study:
    """Reads the results of a study from its folder."""
    path = Path(folder).expanduser()
    return Study(path, json.loads(_engine.study_results(str(path))))


def run(
    study: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    small: bool = False,
    trust: bool = False,
    until: str | None = None,
    progress: bool = True,
    **settings: Any,
) -> Study:
    """Runs the cells of a study that have no results in the folder, with `swm study run`.

    Args:
        study: The path of a TOML file, or the name of a study of the package.
        output: The folder of the study.
        small: Whether to run the small size of the study: minutes on two cores.
        trust: Whether the file may name what loads code or opens connections.
        until: The rule that ends the study, such as `ci=5` or `decided`; `episodes` is the most then.
        progress: Whether to show the output of the command: its progress and the table.
        **settings: Options of all evaluations, with `_` for `-`; a list makes a cell for each value.

    Returns:
        The results.
    """
    output = _files.local("output", output)
    arguments = ["swm", "study", "run", os.fspath(study), "--output", str(output)]
    arguments += [flag for flag, is_set in (("--small", small), ("--trust", trust)) if is_set]
    arguments += [] if until is None else ["--until", until]
    arguments += [f"{name.replace('_', '-')}={_options.setting(value, name)}" for name, value in settings.items()]
    _command(arguments, shows=progress)
    return read(output)


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A row without nested dicts: the names of nested values are joined with dots."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{name}.")
        else:
            flat[name] = value
    return flat
