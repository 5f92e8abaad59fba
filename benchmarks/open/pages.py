"""Pages of robots as built, from the numbers that the benchmark leaves: docs/robots.

Each page has what the maker's description gets wrong, drive parameters with 95 % intervals, the
error on motion that was not fitted with its letter, and what it rests on. Beside it a JSON file has
the numbers, as a prior for a robot of the type (`identify --siblings`).
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from page import MISSING, read_results, split_text
from task import HERE, RESULTS, Task, tasks

from asbuilt.tables import format_share, round_with_error
from asbuilt.validation.prediction import choose_letter, describe_letters

DOCS = HERE.parents[1] / "docs" / "robots"
NUMBERS = HERE / "robots"
SURE = 1.96
"""Standard errors of a 95 % interval."""
MUCH = 1.2
"""Ratio of a link's mass to that of the description, or its inverse, from which it is named."""
TERMS = {
    "Ia": "armature",
    "Fv": "viscous friction",
    "Fc": "Coulomb friction",
    "Fo": "offset",
}


def write_pages(results: Path = RESULTS, folder: Path = DOCS) -> list[Path]:
    """Write the pages of all robots that the benchmark has numbers of, and their list."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = page_texts(results)
    for name, text in texts.items():
        (folder / name).write_text(text)
    return [folder / name for name in texts]


def page_texts(results: Path = RESULTS) -> dict[str, str]:
    """Return the text of each file of the folder by its name."""
    rows = read_results(results)
    texts: dict[str, str] = {}
    lines = []
    for name, task in tasks().items():
        source, own = NUMBERS / f"{name}.json", rows.get((name, "asbuilt"), {})
        if task.kind != "torque" or not task.robot_page:
            continue
        if not source.exists() or own.get("error") is None:
            continue
        numbers = json.loads(source.read_text())
        errors = own["error"], rows.get((name, "cad"), {}).get("error")
        if "cad" in task.skips:  # masses that nobody designed
            numbers |= {"masses": None}
        texts[f"{name}.md"] = robot_page(task, numbers, *errors)
        texts[f"{name}.json"] = robot_document(task, numbers, *errors)
        lines.append(_index_line(task, numbers, *errors))
    head = (HERE / "robots_head.md").read_text().rstrip().replace("RULE", describe_letters())
    texts["index.md"] = "\n".join([head, *lines]) + "\n"
    return texts


def robot_page(task: Task, numbers: dict[str, Any], error: float, cad: float | None) -> str:
    """Return the page of a robot."""
    parts = [
        f"# {task.title}, as built",
        _verdict(error, cad),
        "## What the description gets wrong",
        _wrong(numbers),
        "## Drives",
        "95 % intervals, on the joint's side. A dash: not determined alone by these logs.",
        _drives(numbers),
        "## What it rests on",
        _rests(task, numbers),
        "## As a prior",
        "The numbers are in [the JSON file](" + f"{task.name}.json), without the geometry of the"
        " description. For another robot of the type, whose own log leaves much open:",
        "```bash\nasbuilt identify ROBOT LOG --siblings " + f"{task.name}.json\n```",
        "One robot does not say how much the type varies: compare the held-out error with and"
        " without `--siblings`, and keep the lower.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def robot_document(task: Task, numbers: dict[str, Any], error: float, cad: float | None) -> str:
    """Return the numbers of a page as JSON."""
    document = {
        "title": task.title,
        "letter": choose_letter(error),
        "error": error,
        "description": {"letter": None if cad is None else choose_letter(cad), "error": cad},
        "robots": task.source.robots,
        "source": {"repository": task.source.repository, "commit": task.source.commit or None},
        "logs": list(task.training),
        "test": list(task.test),
        "effects": [each for each in numbers["effects"] if each["in_model"]],
        "drives": numbers["drives"],
        "masses": numbers["masses"],
        "sibling": numbers["sibling"],
    }
    return json.dumps(document) + "\n"


def _verdict(error: float, cad: float | None) -> str:
    letter = choose_letter(error)
    first = (
        f"**{letter}**: as built it predicts motion that was not fitted to {format_share(error)}"
    )
    if cad is None:
        return first + " of the torque. There is no maker's description with masses."
    return (
        f"{first} of the torque. The description as it is: **{choose_letter(cad)}**,"
        f" {format_share(cad)} ([the rule](index.md))."
    )


def _found(numbers: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return name, joint, value and fall of the torque error of the effects that the model has."""
    found = []
    for each in numbers["effects"]:
        if each["in_model"]:
            what, fall = each["text"].split(": torque error ")
            name, joint, value = re.fullmatch(r"(.+?)(?: at (\S+))? (-?\d.*)", what).groups()  # type: ignore[union-attr]
            value = value.replace("+/-", "±").removesuffix(" 1")
            found.append((name, joint or "root", value, fall.replace("->", "→")))
    return found


def _wrong(numbers: dict[str, Any]) -> str:
    parts = []
    if found := _found(numbers):
        head = "| effect that it lacks | where | value ± standard error | torque error |"
        parts.append(
            "\n".join([head, "|---|---|---|---:|", *(f"| {' | '.join(e)} |" for e in found)])
        )
    masses = numbers["masses"]
    if masses and masses["cad"]:
        parts.append(_masses(masses))
    return "\n\n".join(parts) or "Nothing that these logs show beyond friction."


def _masses(masses: dict[str, Any]) -> str:
    """Return the mass of all moving links and of those that differ much."""
    everything = {"name": "all moving links"} | {key: masses[key] for key in ("cad", "as_built")}
    lines = ["| mass [kg] | description | as built |", "|---|---:|---:|"]
    for each in (everything, *masses["links"]):
        ratio = each["as_built"] / each["cad"] if each["cad"] else 1.0
        if each is everything or max(ratio, 1.0 / max(ratio, 1e-9)) > MUCH:
            lines.append(f"| {each['name']} | {each['cad']:.4g} | {each['as_built']:.4g} |")
    return "\n".join(
        [
            "Masses of the robot that is closest to the description and has these torques: all of"
            " it, and links that differ by more than a fifth.\n",
            *lines,
        ]
    )


def _drives(numbers: dict[str, Any]) -> str:
    own = {(each["joint"], each["name"].rstrip("0123456789")): each for each in numbers["drives"]}
    shown = [key for key in TERMS if any(key == symbol for _, symbol in own)]
    units = {key: next(e["unit"] for (_, s), e in own.items() if s == key) for key in shown}
    lines = [
        "| joint | " + " | ".join(f"{TERMS[key]} [{units[key]}]" for key in shown) + " |",
        "|---|" + "---:|" * len(shown),
    ]
    for joint in numbers["joints"]:
        cells = [_interval(own.get((joint, key))) for key in shown]
        lines.append(f"| {joint} | {' | '.join(cells)} |")
    return "\n".join(lines) if shown else "No friction stands alone in these logs."


def _interval(each: dict[str, Any] | None) -> str:
    if each is None or not each["determined"] or not each["error"] > 0.0:
        return MISSING
    value, half = round_with_error(each["value"], SURE * each["error"])
    return f"{value} ± {half}"


def _rests(task: Task, numbers: dict[str, Any]) -> str:
    source = task.source
    commit = f", commit {source.commit}" if source.commit else ""
    many = "one robot" if source.robots == 1 else f"{source.robots} robots"
    return "\n".join(
        [
            f"- {many}; another of the type differs in friction and mounting",
            f"- logs of [{source.repository}]({source.repository}){commit} (licence:"
            f" {source.licence}): {_names(task.training)}; {_tested(task)}",
            f"- {numbers['duration']:.0f} s fitted, method `{numbers['method']}`;"
            f" [the benchmark](../benchmark/index.md#{task.name}) has the other tools",
        ]
    )


def _tested(task: Task) -> str:
    """Say what the error is of."""
    split = split_text(task)
    if not split:
        return f"tested on {_names(task.test)}"
    return f"{split[0].lower()}{split[1:].rstrip('.')} (parts of one motion, not another one)"


def _index_line(task: Task, numbers: dict[str, Any], error: float, cad: float | None) -> str:
    named = sorted({name for name, *_ in _found(numbers)})
    described = MISSING if cad is None else f"{choose_letter(cad)} ({format_share(cad)})"
    masses = numbers["masses"]
    ratio = MISSING
    if masses and masses["cad"]:
        ratio = f"{masses['as_built'] / masses['cad']:.2f}"
    return (
        f"| [{task.title}]({task.name}.md) | **{choose_letter(error)}** ({format_share(error)}) |"
        f" {described} | {ratio} | {', '.join(named) or 'none'} |"
    )


def _names(paths: tuple[str, ...]) -> str:
    return ", ".join(f"`{Path(each).name}`" for each in paths)


if __name__ == "__main__":
    write_pages()
