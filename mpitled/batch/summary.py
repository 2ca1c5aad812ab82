"""The table of a sweep: a row for each case, as CSV, HDF5, Markdown and HTML, and charts of its figures."""

from __future__ import annotations

import json
import math
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpitled import atomic, store
from mpitled.batch import launch
from mpitled.batch.cases import SweepRecord
from mpitled.batch.terminal import print_table
from mpitled.batch.vary import read_csv
from mpitled.deck import unit_of
from mpitled.errors import InputError
from mpitled.results import markup
from mpitled.results.figures import BY_KEY, Figure, look_up

#: Case number, varied keys, figures, warnings, failure and times of one case; "" for a missing value.
Row = dict[str, float | str]


class _Column(NamedTuple):
    """A figure of report.json in the table. `results.figures` declares its label, unit and format."""

    name: str
    key: str  # in report.json; "." separates its levels

    @property
    def figure(self) -> Figure:
        """The declaration of the key, or of the key without its last part."""
        return BY_KEY.get(self.key) or BY_KEY[self.key.rpartition(".")[0]]

    @property
    def heading(self) -> str:
        """Label, part and unit."""
        part = "" if self.figure.key == self.key else self.key.rpartition(".")[2]
        return ", ".join(filter(None, (self.figure.label, part, self.figure.unit)))


COLUMNS = (
    _Column("left_ml", "ventricle_volume_change_ml.left"),
    _Column("right_ml", "ventricle_volume_change_ml.right"),
    _Column("total_ml", "ventricle_volume_change_ml.total"),
    _Column("midline_shift_mm", "midline_shift_mm"),
    _Column("max_displacement_mm", "max_displacement_mm"),
    _Column("share_over_5mm_nodes", "share_over_5mm.nodes"),
    _Column("share_over_5mm_volume", "share_over_5mm.volume"),
    _Column("min_jacobian", "min_jacobian"),
    _Column("static_distance_mm", "static_distance_mm"),
    _Column("cloud_misfit_mm", "cloud_misfit_mm"),
    _Column("volume_balance_error", "volume_balance.relative_error"),
    _Column("steps", "steps"),
    _Column("hexahedra", "cells.hexahedra"),
    _Column("support_domains", "cells.support_domains"),
)
#: In a separate file, because times differ whenever a sweep is repeated.
TIMES = (_Column("loop_s", "seconds.loop"), _Column("whole_s", "seconds"))
WARNINGS = "warnings"
#: The figures that have a chart and a rendered column. Numbers of cells and steps are in the files only.
_FIGURES = COLUMNS[:-3]
_MAX_NAME = 40  # of a case in a chart, characters
_WRAP = 30  # characters in a line of an axis label
#: Columns that are text even if all of their values are empty.
_TEXTS = ("failure", WARNINGS)
#: All columns of table.csv and times.csv except the case and its keys.
NAMES = (*(column.name for column in (*COLUMNS, *TIMES)), WARNINGS, "failure")


class Table(NamedTuple):
    """The rows of all cases, and figures from another source (`--beside`) for the same cases."""

    keys: list[str]  # the varied keys
    rows: list[Row]
    compared: dict[int, Row]  # by the number of the case
    compared_name: str


class _Line(NamedTuple):
    """A line of the rendered table."""

    cells: list[str]
    remark: str = ""  # replaces the figures

    @property
    def all(self) -> list[str]:
        return self.cells + [self.remark] * bool(self.remark)


def collect(sweep: SweepRecord, beside: Path | None = None) -> Table:
    """The results of all cases: completed, broken or not computed.

    `beside` is a CSV file with the varied keys and some columns of this table. InputError for other columns, and for a
    completed case without a readable report.
    """
    rows = []
    for case in sweep.cases:
        failure, report = case.failure, {}
        if failure == "":
            try:
                report = json.loads((case.folder / "report.json").read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                message = f"{case.folder}: has no report ({error}); remove the folder, and sweep again"
                raise InputError(message) from None
        row: Row = {"case": case.number} | {key: _number(case.values.get(key, "")) for key in sweep.keys}
        row |= {column.name: _value_of(report, column) for column in COLUMNS}
        row |= {WARNINGS: "; ".join(report.get(WARNINGS, []))}
        row |= {"failure": "not computed" if failure is None else failure}
        rows.append(row | {column.name: _value_of(report, column) for column in TIMES})
    compared = _read_compared(beside, sweep.keys, rows) if beside else {}
    return Table(sweep.keys, rows, compared, beside.stem if beside else "")


def write(sweep: SweepRecord, table: Table) -> list[Path]:
    """Write table.csv, times.csv, table.h5, table.md, table.html and the charts into the sweep's folder."""
    folder, rows = sweep.folder, table.rows
    paths = [folder / name for name in ("table.csv", "times.csv", "table.h5", "table.md", "table.html")]
    times = ["case", *(column.name for column in TIMES)]
    figures = [name for name in rows[0] if name not in times[1:]]
    atomic.write_csv(paths[0], figures, rows)
    atomic.write_csv(paths[1], times, rows)
    store.write_columns(paths[2], {"table": _columns(rows, figures), "times": _columns(rows, times)})
    atomic.write_text(paths[3], markdown(table))
    with atomic.writing(folder):
        charts = _draw(table, folder)
    atomic.write_text(paths[4], _html(sweep, table, charts))
    programs = {launch.about(case.folder).get("program") for case in sweep.cases if case.failure == ""}
    if len(programs) > 1:
        print(
            f"note: {folder}: {len(programs)} versions of the program computed the cases; remove the older folders and "
            "sweep again to have one version",
            file=sys.stderr,
        )
    return [*paths, *charts]


def markdown(table: Table) -> str:
    """The rendered table in Markdown, and the warnings below it."""
    headings, lines = _rendered(table)
    rows = [f"| {' | '.join(headings)} |", "|" + "---|" * len(headings)]
    for line in lines:
        cells = line.all + [""] * (len(headings) - len(line.all))
        rows.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    warned = [f"- {text}" for text in warnings(table)]
    return "\n".join([*rows, *([""] if warned else []), *warned]) + "\n"


def show(table: Table) -> None:
    """Print the rendered table, and the warnings below it."""
    print_table(*_rendered(table))
    print(*(f"{text}\n" for text in warnings(table)), sep="", end="")


def records(table: Table) -> list[dict[str, Any]]:
    """The rows for JSON: None for a missing number."""
    return [
        {name: None if value == "" and name not in _TEXTS else value for name, value in row.items()}
        for row in table.rows
    ]


def warnings(table: Table) -> list[str]:
    """The warnings of the cases; cases with the same warnings share a line."""
    warned: dict[str, list[str]] = {}
    for row in table.rows:
        if text := str(row[WARNINGS]):
            warned.setdefault(text, []).append(" ".join(f"{key}={_format(row[key])}" for key in table.keys))
    return [f"warning for {', '.join(cases)}: {text}" for text, cases in warned.items()]


# --- the numbers ---------------------------------------------------------------------------------------------------


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _value_of(report: dict[str, Any], column: _Column) -> Any:
    value = look_up(report, column.key)
    if isinstance(value, dict):  # the seconds of all phases
        return float(sum(value.values()))
    return "" if value is None else value


def _read_compared(path: Path, keys: Sequence[str], rows: Sequence[Row]) -> dict[int, Row]:
    """For each case, the row of a CSV file with the same values of the varied keys."""
    lines = read_csv(path, f"give a CSV of {', '.join(keys)} and figures")
    names = lines[0][1] if lines else []
    known = {column.name for column in COLUMNS}
    if missing := [key for key in keys if key not in names]:
        raise InputError(f"{path}: has no column {missing[0]}, which assigns its rows to cases")
    if unknown := [name for name in names if name not in (*keys, *known)]:
        raise InputError(f"{path}: {unknown[0]} is no column of the table; there are {', '.join(sorted(known))}")
    found: dict[int, Row] = {}
    for number, cells in lines[1:]:
        given: Row = {name: _number(cell) for name, cell in zip(names, [*cells, *[""] * len(names)], strict=False)}
        if wrong := [name for name in names if name in known and given[name] != "" and isinstance(given[name], str)]:
            raise InputError(f"{path}: line {number}: {wrong[0]} = {given[wrong[0]]}: is not a number")
        found |= {int(row["case"]): given for row in rows if all(row[key] == given[key] for key in keys)}
    return found


def _columns(rows: Sequence[Row], names: Sequence[str]) -> dict[str, list[float | str]]:
    """Columns for HDF5: numbers, with nan for missing values, or text if any value is a word."""
    columns: dict[str, list[float | str]] = {name: [row[name] for row in rows] for name in names}
    for name, values in columns.items():
        if name not in _TEXTS and all(value == "" or not isinstance(value, str) for value in values):
            columns[name] = [math.nan if value == "" else value for value in values]
    return columns


# --- the rendered table --------------------------------------------------------------------------------------------


def _rendered(table: Table) -> tuple[list[str], list[_Line]]:
    """Headings and lines, without the columns that are empty in all cases; compared figures follow their case."""
    columns = [c for c in (*_FIGURES, TIMES[-1]) if any(row[c.name] != "" for row in table.rows)]
    warned, compared = any(row[WARNINGS] for row in table.rows), bool(table.compared_name)
    headings = [*map(_with_unit, table.keys), *[""] * compared, *["warned"] * warned]
    headings += [column.heading for column in columns] or ["figures"] * (not warned)  # a remark needs a column

    def cells(row: Row) -> list[str]:
        mark = "*" if row.get(WARNINGS) else ""
        figures = [f"{row[c.name]:{c.figure.form}}" if row.get(c.name, "") != "" else "" for c in columns]
        return [*[mark] * warned, *figures]

    lines = []
    for row in table.rows:
        case = [*(_format(row[key]) for key in table.keys), *["here"] * compared]
        failure = str(row["failure"])
        lines.append(_Line(case, failure) if failure else _Line([*case, *cells(row)]))
        if any(figures := cells(table.compared.get(int(row["case"]), {}))):
            lines.append(_Line([*[""] * len(table.keys), table.compared_name, *figures]))
    return headings, lines


def _with_unit(key: str) -> str:
    return f"{key}, {unit}" if (unit := unit_of(key)) else key


def _format(value: float | str) -> str:
    return f"{value:.10g}" if isinstance(value, float) else value


def _draw(table: Table, folder: Path) -> list[Path]:
    """Draw each figure against the first varied number, and the distance from the static solution against run time."""
    try:
        from mpitled.results import charts
    except ImportError:
        message = "no charts, because matplotlib is missing: pip install 'mpitled[pictures]'"
        print(f"{folder}: {message}", file=sys.stderr)
        return []
    rows = [row for row in table.rows if not row["failure"]]
    written = []
    numeric = [key for key in table.keys if len({row[key] for row in rows if not isinstance(row[key], str)}) > 1]
    drawn = [column for column in _FIGURES if any(row[column.name] not in ("", 0) for row in rows)]
    if numeric and drawn:
        key = numeric[0]
        families: dict[str, list[Row]] = {}
        for row in rows:
            if not isinstance(row[key], str):
                name = " ".join(f"{other}={row[other]}" for other in table.keys if other != key)
                families.setdefault(name, []).append(row)
        if table.compared_name:
            families[table.compared_name] = list(table.compared.values())
        written.append(folder / "quantities.png")
        shares = {column.name for column in drawn if "%" in column.figure.form}
        labels = {column.name: textwrap.fill(column.heading, _WRAP) for column in drawn}
        charts.draw_quantities(families, key, _with_unit(key), labels, shares, written[-1])
    if timed := [row for row in rows if row["static_distance_mm"] != "" and row["loop_s"] != ""]:
        points = [
            (float(row["loop_s"]), float(row["static_distance_mm"]), name + (" (warned)" if row[WARNINGS] else ""))
            for row, name in zip(timed, _names(timed, table.keys), strict=True)
        ]
        written.append(folder / "cost.png")
        charts.draw_cost(points, written[-1])
    return written


def _names(rows: Sequence[Row], keys: Sequence[str]) -> list[str]:
    """Names of cases in a chart: the values; those of several keys with short names of the keys if there is space."""
    named = [" ".join(f"{key.rpartition('.')[2]}={_format(row[key])}" for key in keys) for row in rows]
    if len(keys) > 1 and max(map(len, named)) <= _MAX_NAME:
        return named
    return [" ".join(_format(row[key]) for key in keys) for row in rows]


def _html(sweep: SweepRecord, table: Table, charts: Sequence[Path]) -> str:
    """A page with the table and the charts, in one file."""
    headings, lines = _rendered(table)
    captions = {
        "quantities": (
            f"Charts of the results against {table.keys[0]}",
            "Lines join the cases in their order; nothing was computed between the cases. The cloud's uncertainty is "
            "the largest residual of its fit; the error of the volume balance is the unaccounted share of the volume.",
        ),
        "cost": (
            "Chart of the distance from the static solution in mm against the time of the loop in s",
            "The distance of each case from rest, as the case estimates it, against the time of its steps.",
        ),
    }
    head = [f"{len(sweep.cases)} cases of {sweep.deck.name}, varied: {', '.join(table.keys)}"]
    head += [f"All cases with {', '.join(sweep.overrides)}"] if sweep.overrides else []
    head.append(f"Pages of single cases: mpitled report {sweep.cases[0].folder} --html, and so on")
    return markup.render(
        "sweep.html",
        title=sweep.title or sweep.deck.stem,
        head=head,
        headings=headings,
        rows=[line.all for line in lines],
        warnings=warnings(table),
        pictures=[markup.Picture(path.read_bytes(), *reversed(captions[path.stem])) for path in charts],
    )
