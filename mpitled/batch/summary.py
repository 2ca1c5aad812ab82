"""The table of a sweep: a row for each case, as CSV, HDF5, Markdown and HTML, with the charts of it."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpitled import atomic, store
from mpitled.batch import launch
from mpitled.batch.cases import Told
from mpitled.deck import unit_of
from mpitled.errors import InputError
from mpitled.results import markup

Row = dict[str, float | str]


class _Column(NamedTuple):
    """A figure of report.json in the table."""

    name: str
    key: str  # in the report, parts joined by "."
    heading: str  # with its unit
    form: str  # in the rendered table


COLUMNS = (
    _Column("left_ml", "ventricle_volume_change_ml.left", "left ventricle, change, ml", "{:+.3f}"),
    _Column("right_ml", "ventricle_volume_change_ml.right", "right ventricle, change, ml", "{:+.3f}"),
    _Column("total_ml", "ventricle_volume_change_ml.total", "ventricles, change, ml", "{:+.3f}"),
    _Column("midline_shift_mm", "midline_shift_mm", "midline, to the right, mm", "{:+.2f}"),
    _Column("max_displacement_mm", "max_displacement_mm", "largest displacement, mm", "{:.2f}"),
    _Column("share_over_5mm_nodes", "share_over_5mm.nodes", "over 5 mm, share of nodes", "{:.2%}"),
    _Column("share_over_5mm_volume", "share_over_5mm.volume", "over 5 mm, share of volume", "{:.2%}"),
    _Column("min_jacobian", "min_jacobian", "smallest J", "{:.3f}"),
    _Column("static_distance_mm", "static_distance_mm", "from static solution, mm", "{:.4f}"),
    _Column("cloud_misfit_mm", "cloud_misfit_mm", "misfit of cloud, mm", "{:.3f}"),
    _Column("volume_balance_error", "volume_balance.relative_error", "volume balance, error", "{:.2%}"),
    _Column("steps", "steps", "steps", "{:.0f}"),
    _Column("hexahedra", "cells.hexahedra", "hexahedra", "{:.0f}"),
    _Column("support_domains", "cells.support_domains", "support domains", "{:.0f}"),
)
#: In a file of their own, for they are never the same twice.
TIMES = (
    _Column("loop_s", "seconds.loop", "loop, s", "{:.1f}"),
    _Column("whole_s", "seconds", "run time, s", "{:.1f}"),
)
#: People see a mark, and the words below the table.
WARNINGS = _Column("warnings", "warnings", "warned", "{:.0}*")
#: Numbers of the mesh are for the files, not for people, who see the mark first.
_RENDERED = (WARNINGS, *COLUMNS[:-3], TIMES[-1])
#: A name of a case in a chart is no longer.
_LONGEST = 40
#: Columns that are text, though it be empty.
_TEXTS = ("failure", WARNINGS.name)
#: All columns of table.csv and times.csv but the case and its keys.
NAMES = (*(column.name for column in (*COLUMNS, *TIMES, WARNINGS)), "failure")


class _Line(NamedTuple):
    """A line of the table for people."""

    cells: list[str]
    remark: str = ""  # instead of the other cells, why there are no figures


class Table(NamedTuple):
    """The cases that ended, and those that others have of them; numbers, or text where there is none ("")."""

    keys: list[str]  # varied ones
    rows: list[Row]  # case, keys, `COLUMNS`, warnings, failure, for each case of the sweep
    times: list[Row]  # case, `TIMES`
    beside: dict[int, Row]  # by case
    beside_name: str


def collect(sweep: Told, beside: Path | None = None) -> Table:
    """What the cases gave, done, broken or not computed. `beside`: a CSV of the varied keys and columns of ours."""
    rows, times = [], []
    for case in sweep.cases:
        failure = case.failure
        found: dict[str, Any] = {}
        if failure == "":
            try:
                found = json.loads((case.folder / "report.json").read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise InputError(
                    f"{case.folder}: has no report ({error}); remove the folder, and sweep again"
                ) from None
        given: Row = {"case": case.number} | {key: _number(case.values.get(key, "")) for key in sweep.keys}
        figures: Row = {column.name: _figure(found, column.key) for column in COLUMNS}
        warned: Row = {WARNINGS.name: "; ".join(found.get(WARNINGS.key, []))}
        rows.append(given | figures | warned | {"failure": "not computed" if failure is None else failure})
        times.append({"case": case.number} | {column.name: _figure(found, column.key) for column in TIMES})
    theirs = _read_beside(beside, sweep.keys, rows) if beside else {}
    return Table(sweep.keys, rows, times, theirs, beside.stem if beside else "")


def write(sweep: Told, table: Table) -> list[Path]:
    """Write table.csv, times.csv, table.h5, table.md, table.html and the charts into the sweep's folder."""
    folder = sweep.folder
    paths = [folder / name for name in ("table.csv", "times.csv", "table.h5", "table.md", "table.html")]
    atomic.write_csv(paths[0], list(table.rows[0]), table.rows)
    atomic.write_csv(paths[1], list(table.times[0]), table.times)
    groups = {"table": table.rows, "times": table.times}
    store.write_columns(paths[2], {name: _columns(rows) for name, rows in groups.items()})
    atomic.write_text(paths[3], markdown(table))
    with atomic.writing(folder):
        charts = _draw(table, folder)
    atomic.write_text(paths[4], _html(sweep, table, charts))
    programs = {launch.about(case.folder).get("program") for case in sweep.cases if case.failure == ""}
    if len(programs) > 1:
        print(
            f"note: {folder}: the cases are of {len(programs)} versions of the program; remove the older folders and "
            "sweep again to have one",
            file=sys.stderr,
        )
    return [*paths, *charts]


def markdown(table: Table) -> str:
    """The table for people, in Markdown: under each case's row the one of others, if they have it."""
    headings, lines = _rendered(table)
    text = [f"| {' | '.join(headings)} |", "|" + "---|" * len(headings)]
    for line in lines:
        cells = line.cells + [line.remark] * bool(line.remark)
        cells += [""] * (len(headings) - len(cells))
        text.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    warned = [f"- {words}" for words in warnings(table)]
    return "\n".join([*text, *([""] if warned else []), *warned]) + "\n"


def text(table: Table) -> str:
    """The table for a terminal."""
    headings, lines = _rendered(table)
    cells = [[*heading.split(", ")] for heading in headings]
    depth = max(map(len, cells))
    heads = [[(words + [""] * depth)[i] for words in cells] for i in range(depth)]
    rows = [*(_Line(head) for head in heads), *lines]
    widths = [max(len(line.cells[i]) for line in rows if i < len(line.cells)) for i in range(len(headings))]
    made = []
    for line in rows:
        shown = [f"{cell:>{width}}" for cell, width in zip(line.cells, widths, strict=False)]
        made.append("  ".join([*shown, line.remark] if line.remark else shown))
    return "\n".join([*made, *warnings(table)])


def records(table: Table) -> list[dict[str, Any]]:
    """The rows with their times, for JSON."""
    return [
        {name: None if value == "" and name not in _TEXTS else value for name, value in (row | time).items()}
        for row, time in zip(table.rows, table.times, strict=True)
    ]


# --- the numbers ---------------------------------------------------------------------------------------------------


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _figure(report: Any, key: str) -> float | str:
    for part in key.split("."):
        report = report.get(part) if isinstance(report, dict) else None
    if isinstance(report, dict):  # phases, of which the whole is asked for
        return float(sum(report.values()))
    return "" if report is None else report


def _read_beside(path: Path, keys: Sequence[str], rows: Sequence[Row]) -> dict[int, Row]:
    """By case, the row with the same values of the varied keys."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            names, theirs = reader.fieldnames or [], list(reader)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a CSV of {', '.join(keys)} and figures") from None
    known = {column.name for column in COLUMNS}
    if missing := [key for key in keys if key not in names]:
        raise InputError(f"{path}: has no column {missing[0]}, by which its rows belong to cases")
    if strange := [name for name in names if name not in (*keys, *known)]:
        raise InputError(f"{path}: {strange[0]} is no column of the table; there are {', '.join(sorted(known))}")
    found: dict[int, Row] = {}
    for line, given in enumerate(theirs, 2):
        their = {name: _number(given[name] or "") for name in names}
        if wrong := [name for name in names if name in known and their[name] != "" and isinstance(their[name], str)]:
            raise InputError(f"{path}: line {line}: {wrong[0]} = {their[wrong[0]]}: is not a number")
        for row in rows:
            if all(row[key] == their[key] for key in keys):
                found[int(row["case"])] = their
    return found


def _columns(rows: Sequence[Row]) -> dict[str, list[float | str]]:
    """Columns of numbers with nan where there is none; of text if there is a word in it, or for `_TEXTS`."""
    columns: dict[str, list[float | str]] = {name: [row[name] for row in rows] for name in rows[0]}
    for name, values in columns.items():
        if name not in _TEXTS and all(value == "" or not isinstance(value, str) for value in values):
            columns[name] = [math.nan if value == "" else value for value in values]
    return columns


# --- what people see -----------------------------------------------------------------------------------------------


def _rendered(table: Table) -> tuple[list[str], list[_Line]]:
    """Headings and lines of cells; of columns that no case has, none."""
    columns = [c for c in _RENDERED if any((row | time)[c.name] != "" for row, time in _pairs(table))]
    headings = [f"{key}, {unit}" if (unit := unit_of(key)) else key for key in table.keys]
    headings += [*([""] if table.beside else []), *(column.heading for column in columns)]
    headings += [] if columns else ["figures"]  # none: there is room for why
    lines = []
    for row, time in _pairs(table):
        values = [_value(row[key]) for key in table.keys]
        who = ["here"] if table.beside else []
        if row["failure"]:
            lines.append(_Line([*values, *who], str(row["failure"])))
        else:
            lines.append(_Line([*values, *who, *_cells(row | time, columns)]))
        if any(theirs := _cells(table.beside.get(int(row["case"]), {}), columns)):
            lines.append(_Line([*[""] * len(values), table.beside_name, *theirs]))
    return headings, lines


def warnings(table: Table) -> list[str]:
    """What the marked cases were warned of, a line for all that were warned of the same."""
    warned: dict[str, list[str]] = {}
    for row in table.rows:
        if words := str(row[WARNINGS.name]):
            warned.setdefault(words, []).append(" ".join(f"{key}={_value(row[key])}" for key in table.keys))
    return [f"warning for {', '.join(marked)}: {words}" for words, marked in warned.items()]


def _pairs(table: Table) -> Iterator[tuple[Row, Row]]:
    return zip(table.rows, table.times, strict=True)


def _cells(row: Row, columns: Sequence[_Column]) -> list[str]:
    return [c.form.format(row[c.name]) if row.get(c.name, "") != "" else "" for c in columns]


def _draw(table: Table, folder: Path) -> list[Path]:
    """The charts: each quantity against the first varied key that is a number; distance from rest against run time."""
    try:
        from mpitled.results import charts
    except ImportError:
        print(f"{folder}: no charts, for matplotlib is missing: pip install 'mpitled[pictures]'", file=sys.stderr)
        return []
    rows = [row | time for row, time in _pairs(table) if not row["failure"]]
    made = []
    numeric = [key for key in table.keys if len({row[key] for row in rows if not isinstance(row[key], str)}) > 1]
    drawn = [column for column in COLUMNS[:-3] if any(row[column.name] not in ("", 0) for row in rows)]
    if numeric and drawn:
        key = numeric[0]
        others = [other for other in table.keys if other != key]
        families: dict[str, list[Row]] = {}
        for row in rows:
            if not isinstance(row[key], str):
                families.setdefault(" ".join(f"{other}={row[other]}" for other in others), []).append(row)
        if table.beside:
            families[table.beside_name] = list(table.beside.values())
        quantities, shares = {c.name: c.heading for c in drawn}, {c.name for c in drawn if "%" in c.form}
        label = f"{key}, {unit}" if (unit := unit_of(key)) else key
        charts.draw_quantities(families, key, label, quantities, shares, folder / "quantities.png")
        made.append(folder / "quantities.png")
    if timed := [row for row in rows if row["static_distance_mm"] != "" and row["loop_s"] != ""]:
        points = [
            (float(row["loop_s"]), float(row["static_distance_mm"]), name + (" (warned)" if row[WARNINGS.name] else ""))
            for row, name in zip(timed, _names(timed, table.keys), strict=True)
        ]
        charts.draw_cost(points, folder / "cost.png")
        made.append(folder / "cost.png")
    return made


def _value(value: float | str) -> str:
    return f"{value:.10g}" if isinstance(value, float) else value


def _names(rows: Sequence[Row], keys: Sequence[str]) -> list[str]:
    """Cases in a chart: the value of a key; of several keys with the last parts of their names, if there is room."""
    named = [" ".join(f"{key.rpartition('.')[2]}={_value(row[key])}" for key in keys) for row in rows]
    if len(keys) > 1 and max(map(len, named)) <= _LONGEST:
        return named
    return [" ".join(_value(row[key]) for key in keys) for row in rows]


def _html(sweep: Told, table: Table, charts: Sequence[Path]) -> str:
    """A page that is one file: the table, and the charts."""
    headings, lines = _rendered(table)
    title, n = sweep.title or sweep.deck.stem, len(sweep.cases)
    alt = {
        "quantities": f"Charts of the results against {table.keys[0]}",
        "cost": "Chart of the distance from the static solution in mm against the time of the loop in s",
    }
    captions = {
        "quantities": "Lines join the cases in their order, between which nothing was computed. The misfit is what the "
        "cloud is uncertain by at its worst node; the volume balance, what of the grown volume was not found again.",
        "cost": "How far each case ended from rest, by its own estimate, against the time that its steps took.",
    }
    head = [f"{n} cases of {sweep.deck.name}, varied: {', '.join(table.keys)}"]
    head += [f"All of them with {', '.join(sweep.base)}"] if sweep.base else []
    head.append(f"Pages of single cases: mpitled report {sweep.cases[0].folder} --html, and so on")
    return markup.render(
        "sweep.html",
        title=title,
        head=head,
        headings=headings,
        rows=[line.cells + [line.remark] * bool(line.remark) for line in lines],
        warnings=warnings(table),
        pictures=[markup.Picture(path.read_bytes(), alt[path.stem], captions[path.stem]) for path in charts],
    )
