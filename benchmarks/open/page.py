"""The page of the open benchmark, from the file of results: tables, and a picture for each task."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from plain import EDGE
from task import HERE, RESULTS, Task, tasks
from tool import Tool, tools

Row = dict[str, Any]
DOCS = HERE.parents[1] / "docs"
PAGE = DOCS / "benchmark" / "index.md"
PICTURES = DOCS / "built" / "benchmark"
MISSING = "–"
LEAD = 0.1
"""Part of the best other error by which a tool leads: one recording of a robot is one sample."""
FEW = 0.005
"""Error below which a percentage has three digits: it is one of a range, not of a torque."""
KINDS = {
    "torque": "Torque on another motion",
    "legs": "Legs on the ground",
    "twin": "Legs on the ground, with a known truth",
    "payload": "Payload of known mass",
    "ratio": "Two weights of known ratio",
    "command": "Command without torque",
    "halves": "Two halves: do the stated errors hold?",
    "virtual": "Virtual robots with known truth",
}

COMPARED = {"halves": "z_rms", "twin": "true_error"}
"""What tools are compared by where it is not the error on the test."""
AXES = {
    "twin": "error from the true torque [%]",
    "payload": "error of the mass [%]",
    "ratio": "error of the ratio [%]",
    "command": "position error in windows of the test [mrad]",
}
"""What pictures show where it is no torque."""


def read_results(path: Path = RESULTS) -> dict[tuple[str, str], Row]:
    """Return the rows by task and tool."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {(row["task"], row["tool"]): row for row in rows}


def write_page(path: Path = RESULTS) -> None:
    """Write the page."""
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page_text(path))


def page_text(path: Path = RESULTS) -> str:
    """Return the page."""
    results = read_results(path)
    shown = {name: task for name, task in tasks().items() if any(t == name for t, _ in results)}
    days = sorted({row["date"] for row in results.values() if row.get("date")})
    head = (HERE / "page_head.md").read_text().rstrip()
    parts = [head.replace("DAYS", " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "")]
    for kind, title in KINDS.items():
        own = {name: task for name, task in shown.items() if task.kind == kind}
        if own:
            parts.append(f"## {title}\n\n{_kind_table(kind, own, results)}")
            parts += [_floor_text(task, results) for task in own if kind == "twin"]
            parts.append(_standing(kind, own, results))
    parts.append(f"## What else counts\n\n{_tool_table(shown, results)}")
    parts.append(f"## The tasks\n\n{_task_sections(shown, results)}")
    parts.append((HERE / "page_tail.md").read_text().rstrip())
    return "\n\n".join(part for part in parts if part) + "\n"


def value_of(kind: str, row: Row | None) -> float | None:
    """Return the number by which the tools of a kind of task are compared."""
    return None if row is None else row.get(COMPARED.get(kind, "error"))


def cell(kind: str, row: Row | None, best: float | None) -> str:
    """Return a number of a table, the best one in bold."""
    value = value_of(kind, row)
    if value is None or row is None:
        return MISSING
    if kind == "halves":
        text = f"{100 * row['coverage']:.0f} % (z {value:.1f})"
    else:
        text = shown(kind, value)
        if kind == "twin":
            text += f"<br>score {shown(kind, row['error'])}"
        if kind == "virtual":
            covered = row.get("coverage")
            text += "" if covered is None else f"<br>{100 * covered:.0f} % hold"
    return f"**{text}**" if value == best else text


def shown(kind: str, value: float) -> str:
    """Return an error: position errors in mrad, others as a part."""
    if kind == "command":
        return f"{1000 * value:.1f} mrad"
    if kind == "twin":  # all near the errors of the log
        return f"{100 * value:.2f} %"
    return f"{100 * value:.{3 if value < FEW else 1}f} %"


def best_of(kind: str, values: Sequence[float | None]) -> float | None:
    """Return the best of some numbers: the least error, or the z nearest to 1 as a factor."""
    known = [each for each in values if each is not None]
    if not known:
        return None
    return min(known, key=lambda value: _cost(kind, value))


def _cost(kind: str, value: float) -> float:
    """Return what is least for the best: the error, or z as a factor from 1."""
    return max(value, 1.0 / value) if kind == "halves" and value > 0 else value


def _kind_table(kind: str, own: dict[str, Task], results: dict[tuple[str, str], Row]) -> str:
    names = [
        name
        for name in tools()
        if any(value_of(kind, results.get((task, name))) is not None for task in own)
    ]
    lines = ["| task | " + " | ".join(names) + " |", "|---|" + "---:|" * len(names)]
    for task in own:
        rows = [results.get((task, name)) for name in names]
        best = best_of(kind, [value_of(kind, row) for row in rows])
        cells = " | ".join(cell(kind, row, best) for row in rows)
        lines.append(f"| [{task}](#{task}) | {cells} |")
    return "\n".join(lines)


def _floor_text(task: str, results: dict[tuple[str, str], Row]) -> str:
    """Say what the true torques score, and who fits errors of the log."""
    rows = {name: row for name in tools() if (row := results.get((task, name), {})).get("floor")}
    if not rows:
        return ""
    floor = next(iter(rows.values()))["floor"]
    below = sorted((row["error"], name) for name, row in rows.items() if row["error"] < floor)
    text = (
        f"By the score of the recorded log, the true torques of {task} have {shown('twin', floor)}"
    )
    if below:
        each = ", ".join(f"{name} {shown('twin', error)}" for error, name in below)
        text += f"; what is below that has fitted errors of the log: {each}"
    return text + "."


def _standing(kind: str, own: dict[str, Task], results: dict[tuple[str, str], Row]) -> str:
    """Say where asbuilt leads, where nobody leads by what counts, and where it is behind."""
    behind, led, level = [], 0, []
    for task in own:
        values = {name: value_of(kind, results.get((task, name))) for name in tools()}
        ours, best = values.pop("asbuilt"), best_of(kind, list(values.values()))
        if ours is None or best is None:
            continue
        if kind in ("payload", "ratio") and abs(ours - best) < _spread(results[task, "asbuilt"]):
            level.append(task)
            continue
        if best_of(kind, [ours, best]) == ours:
            if _cost(kind, ours) > (1.0 - LEAD) * _cost(kind, best):
                level.append(task)
            else:
                led += 1
            continue
        if _cost(kind, best) > (1.0 - LEAD) * _cost(kind, ours):
            level.append(task)
            continue
        who = next(name for name, value in values.items() if value == best)
        own_text, other = (
            f"z {value:.1f}" if kind == "halves" else shown(kind, value) for value in (ours, best)
        )
        behind.append(f"{task} ({own_text}, {who} {other})")
    if not led and not behind and not level:
        return ""
    sentence = f"asbuilt leads {led} of {led + len(level) + len(behind)}"
    if level:
        sentence += (
            f"; on {', '.join(level)} the best two are level: less than a tenth apart, or what is"
            " weighed less than its standard error"
        )
    return sentence + (f"; it is behind on {', '.join(behind)}." if behind else ".")


def _spread(row: Row) -> float:
    """Return the standard error that a tool states of what is weighed, over its true value."""
    return float(row["error"] / row["z_rms"]) if row.get("z_rms") else 0.0


def _tool_table(shown: dict[str, Task], results: dict[tuple[str, str], Row]) -> str:
    lines = [
        "| tool | version | tasks answered | physically consistent | mass over CAD | CPU, median"
        " | lines |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    silent = []
    for name, tool in tools().items():
        rows = [row for task in shown if (row := results.get((task, name)))]
        done = [row for row in rows if row.get("cpu_seconds") is not None]
        if not done:
            reason = tool.cannot.get("*", "no result in this run")
            silent.append(f"No task is one for [{tool.title}]({tool.address}): it {reason}.")
            continue
        physical = [row["consistent"] for row in done if row.get("consistent") is not None]
        masses = [row["mass_ratio"] for row in done if row.get("mass_ratio") is not None]
        cpu = sorted(row["cpu_seconds"] for row in done)[len(done) // 2]
        lines.append(
            f"| [{tool.title}]({tool.address}) (`{name}`) | {done[0].get('version')} |"
            f" {len(done)} |"
            f" {f'{sum(physical)} of {len(physical)}' if physical else MISSING} |"
            f" {f'{min(masses):.2f} to {max(masses):.2f}' if masses else MISSING} |"
            f" {cpu:.1f} s | {tool.lines} |"
        )
    return "\n".join(["\n".join(lines), *(f"\n{each}" for each in silent)])


def _task_sections(shown: dict[str, Task], results: dict[tuple[str, str], Row]) -> str:
    return "\n\n".join(_task_section(task, results) for task in shown.values())


def _task_section(task: Task, results: dict[tuple[str, str], Row]) -> str:
    source = task.source
    where = f"[{source.repository}]({source.repository})"
    if "://" not in source.repository:
        where = source.repository
    commit = f", commit {source.commit}" if source.commit else ""
    lines = [f"### {task.name}", "", f"{task.title}. {task.note}".strip(), ""]
    lines.append(f"Data: {where}{commit}; licence: {source.licence}.")
    if split := split_text(task):
        lines.append(split)
    elif task.training:
        lines.append(f"Training: {_files(task.training)}.")
    if task.test:
        start = "" if task.test_seconds is None else f" (first {task.test_seconds:g} s)"
        lines.append(f"Test: {_files(task.test)}{start}.")
    edge = "" if task.edge == EDGE else f"; ends not scored: {task.edge:g} s"
    lines += [f"Low-pass of the score: {task.cutoff:g} Hz{edge}.", ""]
    own = {name: results.get((task.name, name)) for name in tools()}
    if task.kind != "halves":
        lines += [f"![Error by tool](../built/benchmark/{task.name}.png)", ""]
    lines += [
        "| tool | result | mass over CAD | consistent | CPU | note |",
        "|---|---:|---:|---|---:|---|",
    ]
    for name, row in own.items():
        if row is not None and "*" not in tools()[name].cannot:
            lines.append(_task_row(task, name, row))
    return "\n".join(lines)


def split_text(task: Task) -> str:
    """Say which part of its logs a task without a test predicts, or nothing."""
    if "trained" in task.settings:
        part = 100.0 * task.settings["trained"]
        return f"Training: the first {part:.0f} % of {_files(task.training)}; test: the rest."
    if "blocks" in task.settings:
        seconds, every = task.settings["blocks"]
        whole = f"{every} blocks of {seconds:g} s of {_files(task.training)}"
        return f"Test: one of {whole}; training: the others."
    return ""


def _task_row(task: Task, name: str, row: Row) -> str:
    mass, physical, cpu = (row.get(key) for key in ("mass_ratio", "consistent", "cpu_seconds"))
    note = ("failed: " if row.get("failed") else "") + str(row.get("note") or "")
    cells = [
        name,
        cell(task.kind, row, None),
        MISSING if mass is None else f"{mass:.2f}",
        MISSING if physical is None else ("yes" if physical else "no"),
        MISSING if cpu is None else f"{cpu:.1f} s",
        " ".join(note.replace("|", "/").split()),
    ]
    return f"| {' | '.join(cells)} |"


def _files(paths: Sequence[str]) -> str:
    return ", ".join(f"`{Path(each).name}`" for each in paths)


def draw_pictures(folder: Path = PICTURES, path: Path = RESULTS) -> None:
    """Draw a bar for each tool and task."""
    folder.mkdir(parents=True, exist_ok=True)
    results, known = read_results(path), tools()
    for task in tasks().values():
        bars = _bars(task, known, results)
        if not bars or task.kind == "halves":
            continue
        figure, axes = plt.subplots(figsize=(6.4, 0.5 + 0.3 * len(bars)), layout="constrained")
        names, values = zip(*bars, strict=True)
        colours = ["#d9731a" if name == "asbuilt" else "#7f9bb8" for name in names]
        drawn = axes.barh(names, values, color=colours)
        unit = "mrad" if task.kind == "command" else "%%"
        axes.bar_label(drawn, fmt=f"%.1f {unit}", padding=3)
        axes.invert_yaxis()
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0.0, 1.15 * max(values))
        axes.set_xlabel(AXES.get(task.kind, "error on the test [% of the torque]"))
        figure.savefig(folder / f"{task.name}.png", facecolor="white", dpi=110)
        plt.close(figure)


def _bars(
    task: Task, known: dict[str, Tool], results: dict[tuple[str, str], Row]
) -> list[tuple[str, float]]:
    found = {name: value_of(task.kind, results.get((task.name, name))) for name in known}
    unit = 1000.0 if task.kind == "command" else 100.0
    return [(name, unit * value) for name, value in found.items() if value is not None]


if __name__ == "__main__":
    write_page()
    draw_pictures()
