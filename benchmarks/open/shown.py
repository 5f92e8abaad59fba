"""Numbers that pages say: from the benchmark's rows and from what commands print, by generation.

    python benchmarks/open/shown.py --run    # run the commands of the pages, keep what they print
    python benchmarks/open/shown.py          # write the pages from what is kept

`shown.toml` names the commands, the blocks that show their prints, and the sentences that say a
number; prints are kept in `prints/`. A page keeps its words: where a command prints other words
than a block shows, that line is named and left as it is.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from page import read_results, write_page
from pages import write_pages
from task import HERE, RESULTS, SHARED, tasks

HOUSE = HERE.parents[1]
PRINTS = HERE / "prints"
QUOTES = HERE / "shown.toml"
PAGES = (
    *("README.md", "docs/index.md", "docs/tutorial.md"),
    "docs/explanation/what-a-log-determines.md",
)
"""Pages of prose whose numbers are renewed; those of docs/benchmark and docs/robots are written
whole, and notebooks are kept without outputs."""
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:e[-+]?\d+)?")
QUANTITY = re.compile(r"(?<![\w.])(\d[\d.]*?)\.?\s?(%|kg\b)")
"""A number of percent or kilograms; `0.1 to 9.8 kg` has a further number, see `quantities`."""
RANGE = re.compile(r"(?<![\w.])(\d[\d.]*) (?:to|and|or) (?=\d[\d.]* ?(?:%|kg\b))")


@dataclass(frozen=True)
class Quotes:
    """What `shown.toml` says: commands by name, sentences, and numbers that are no results."""

    commands: dict[str, dict[str, Any]]
    sentences: list[dict[str, Any]]
    constants: dict[str, str]

    @classmethod
    def read(cls, path: Path = QUOTES) -> Quotes:
        """Read the file."""
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        return cls(values["commands"], values["sentences"], values["constants"])


def masked(line: str) -> str:
    """Return the words of a line, its numbers replaced by `#`, its rules gone."""
    return " ".join(NUMBER.sub("#", re.sub(r"-{3,}", " ", line)).split())


def renewed_block(shown: list[str], printed: list[str]) -> tuple[list[str], list[str]]:
    """Return the lines of a block with the numbers of a print, and the lines that it lacks.

    Lines are found in order by their words; an ellipsis stands for lines left out, or for the rest
    of its line, which is kept as it is.
    """
    at, found, lacking = 0, [], []
    for line in shown:
        if not line.strip() or line.strip() == "...":
            found.append(line)
            continue
        own, cut = masked(line.removesuffix("...")), line.endswith("...")
        places = [
            k
            for k in range(at, len(printed))
            if (masked(printed[k]).startswith(own) if cut else masked(printed[k]) == own)
        ]
        if not own:  # a rule: the next one
            places = [
                k for k in range(at, len(printed)) if re.fullmatch(r"\s*-{3,}\s*", printed[k])
            ]
        if not places:
            lacking.append(line)
            found.append(line)
            continue
        at = places[0] + 1
        found.append(line if cut else printed[places[0]])
    return found, lacking


def renewed_page(text: str, quotes: Quotes, page: str) -> tuple[str, list[str]]:
    """Return a page with the numbers of the run, and what it shows that is printed no longer."""
    lacking: list[str] = []
    prints = [
        (PRINTS / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        for name, each in quotes.commands.items()
        if page in each["pages"] and (PRINTS / f"{name}.txt").exists()
    ]

    def block(found: re.Match[str]) -> str:
        lines = found[2].splitlines()
        if not prints or found[1] not in ("", "console"):
            return found[0]
        options = [renewed_block(lines, printed) for printed in prints]
        best = min(options, key=lambda each: len(each[1]))
        if len(best[1]) > len(lines) // 2:  # a block of commands, or of another kind
            return found[0]
        lacking.extend(best[1])
        return f"```{found[1]}\n" + "".join(f"{line}\n" for line in best[0]) + "```"

    text = re.sub(r"^```(\w*)\n(.*?)^```", block, text, flags=re.DOTALL | re.MULTILINE)
    for name in re.findall(r"<!-- shown: ([\w-]+) -->", text):
        pattern = rf"(<!-- shown: {name} -->\n)(.*?)(\n<!-- end -->)"
        table = feasible_table(name, quotes.commands[name])
        text = re.sub(pattern, lambda m, table=table: m[1] + table + m[3], text, flags=re.DOTALL)
    for sentence in quotes.sentences:
        if sentence["page"] == page:
            text, found = renewed_sentence(text, sentence)
            if not found:
                lacking.append(sentence["text"])
    return text, lacking


def renewed_sentence(text: str, sentence: dict[str, Any]) -> tuple[str, bool]:
    """Return a text with a sentence in which `{name}` is the value of its source."""
    parts = re.split(r"\{(\w+)\}", sentence["text"])
    pattern, names = "", []
    for k, part in enumerate(parts):
        if k % 2:
            names.append(part)
            pattern += r"([-\d.]+)"
        else:
            pattern += r"(" + r"\s+".join(map(re.escape, part.split(" "))) + r")"
    found = re.search(pattern, text)
    if found is None:
        return text, False
    values = {name: value_of(sentence["from"][name]) for name in names}
    whole = "".join(values[parts[k]] if k % 2 else found[k + 1] for k in range(len(parts)))
    return text[: found.start()] + whole + text[found.end() :], True


def value_of(source: str) -> str:
    """Return what a source says as it is printed.

    `TASK/TOOL/FIELD`: a number of the benchmark, in percent to one digit. `NAME: PATTERN`: the
    group of a pattern in what a command printed.
    """
    if ": " in source:
        name, pattern = source.split(": ", 1)
        found = re.search(pattern, (PRINTS / f"{name}.txt").read_text(encoding="utf-8"))
        if found is None:
            raise ValueError(f"{name} prints nothing like {pattern!r}")
        return found[1]
    task, tool, field = source.split("/")
    return f"{100.0 * read_results(RESULTS)[task, tool][field]:.1f}"


def feasible_table(name: str, command: dict[str, Any]) -> str:
    """Return what `asbuilt feasible` printed as a table of the page, truth beside it."""
    printed = (PRINTS / f"{name}.txt").read_text(encoding="utf-8")
    truth = command.get("truth")
    known: dict[str, float] = {}
    if truth:
        known = json.loads((PRINTS / truth).read_text(encoding="utf-8"))
    head = "| mass [kg] | CAD | truth | feasible (95 %) | exported |"
    lines = [head, "|---|---:|---:|---|---:|"] if truth else [
        head.replace(" truth |", ""), "|---|---:|---|---:|"
    ]  # fmt: skip
    row = re.compile(r"^(mass\S*) +(\S+)  (.+?)  +(\S+)  (.*)$", re.MULTILINE)
    for quantity, cad, feasible, chosen, confounded in row.findall(printed):
        link = quantity.partition(":")[2] or "all moving links"
        if quantity not in command.get("rows", [quantity]):
            continue
        silent = ": in no torque" if confounded.startswith("no torque") and ":" in quantity else ""
        cells = [link, cad]
        if truth:
            cells.append(f"{known[link]:.3g}" if link in known else f"{sum(known.values()):.3g}")
        cells += [feasible.replace(" kg", "") + silent, chosen]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def run_commands(name: str, command: dict[str, Any], folder: Path) -> str:
    """Return what the lines of a command print, each below its `$`, in a folder."""
    lines = command.get("lines") or page_commands(HOUSE / command["pages"][0])
    environment = os.environ | {"COLUMNS": "80", "PYTHONPATH": str(HOUSE / "src")}
    out = []
    for line in lines:
        words = shlex.split(line.format(data=SHARED))
        started = ["-m", "asbuilt"] if words[0] == "asbuilt" else [str(HOUSE / words.pop(1))]
        done = subprocess.run(
            [sys.executable, *started, *words[1:]],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{name}: {line} ended with {done.returncode}:\n{done.stderr}")
        out += [f"$ {line}", done.stdout.replace(f"{SHARED}/", "")]
    for block in python_blocks(HOUSE / command["pages"][0]) if command.get("python") else []:
        out.append(
            subprocess.run(
                [sys.executable, "-c", block],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
    return "\n".join(out)


def page_commands(page: Path) -> list[str]:
    """Return the commands that the console blocks of a page show."""
    blocks = re.findall(
        r"^```console\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    return [line[2:] for each in blocks for line in each.splitlines() if line.startswith("$ ")]


def python_blocks(page: Path) -> list[str]:
    """Return the Python of a page that prints a number."""
    found = re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return [each for each in found if "print(f" in each]


def keep_prints(quotes: Quotes, names: list[str]) -> None:
    """Run the commands and keep what they print; those of one `folder` see each other's files.

    Folders run side by side, those of most commands first.
    """
    PRINTS.mkdir(exist_ok=True)
    folders: dict[str, dict[str, dict[str, Any]]] = {}
    for name, command in quotes.commands.items():
        if names and name not in names and command.get("folder") not in names:
            continue
        if any(not (SHARED / each).exists() for each in command.get("needs", [])):
            print(f"{name}: {SHARED} lacks {', '.join(command['needs'])}; its print stays")
            continue
        folders.setdefault(command.get("folder", name), {})[name] = command
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(os.cpu_count()) as pool:
        work = [
            pool.submit(keep_folder, own, Path(scratch) / folder)
            for folder, own in sorted(folders.items(), key=lambda each: -len(each[1]))
        ]
        for each in work:
            each.result()


def keep_folder(commands: dict[str, dict[str, Any]], folder: Path) -> None:
    """Run commands one after the other in a folder, and keep what each prints."""
    folder.mkdir()
    for name, command in commands.items():
        text = run_commands(name, command, folder)
        (PRINTS / f"{name}.txt").write_text(tidied(text), encoding="utf-8")
        if "truth" in command:
            masses = true_masses(folder / "log_truth.json", folder / "log_robot.toml")
            (PRINTS / command["truth"]).write_text(json.dumps(masses) + "\n", encoding="utf-8")
        print(f"{name}: {len(text.splitlines())} lines", flush=True)


def tidied(text: str) -> str:
    """Return a print without blanks at the ends of lines and of the file."""
    return "\n".join(line.rstrip() for line in text.splitlines()).rstrip() + "\n"


def true_masses(truth: Path, robot: Path) -> dict[str, float]:
    """Return the mass of each link of a virtual robot."""
    values = json.loads(truth.read_text(encoding="utf-8"))["parameters"]
    links = [each["name"] for each in tomllib.loads(robot.read_text("utf-8"))["links"]]
    return {name: float(values[f"m{k + 1}"]) for k, name in enumerate(links)}


def quantities(text: str) -> list[str]:
    """Return the numbers of percent and kilograms of a text as they are written."""
    found = [f"{number} {unit}" for number, unit in QUANTITY.findall(text)]
    for first in RANGE.finditer(text):
        unit = QUANTITY.search(text, first.end())
        assert unit is not None
        found.append(f"{first[1]} {unit[2]}")
    return found


def known_numbers() -> tuple[set[str], list[float]]:
    """Return the numbers of the prints and tasks as they are written, and those of the rows.

    Percent and masses: errors and coverage of the rows, and the numbers of the robots' files.
    """
    texts = [path.read_text(encoding="utf-8") for path in sorted(PRINTS.glob("*"))]
    texts += [path.read_text(encoding="utf-8") for path in sorted((HERE / "tasks").glob("*.toml"))]
    written = {each.lstrip("+-").rstrip(".") for text in texts for each in NUMBER.findall(text)}
    values: list[float] = []
    for row in read_results(RESULTS).values():
        for key in ("error", "coverage", "true_error", "floor"):
            if row.get(key) is not None:
                values.append(100.0 * row[key])
        written |= {each.rstrip(".") for each in NUMBER.findall(row.get("note") or "")}
    values += [100.0 * task.settings["trained"] for task in tasks().values()
               if "trained" in task.settings]  # fmt: skip
    for path in sorted((HERE / "robots").glob("*.json")):
        document = json.loads(path.read_text(encoding="utf-8"))
        masses = document["masses"]
        if masses:
            values += [masses["cad"], masses["as_built"]]
            values += [each[key] for each in masses["links"] for key in ("cad", "as_built")]
        for effect in document["effects"]:
            written |= {each.rstrip(".") for each in NUMBER.findall(effect["text"])}
    return written, [each for each in values if each is not None]


def strays(text: str, constants: dict[str, str]) -> list[str]:
    """Return the quantities of a text that stand nowhere in the files of the run."""
    written, values = known_numbers()
    return [each for each in quantities(text) if not (
        each in constants or _stands(each.split()[0], written, values)
    )]  # fmt: skip


def _stands(number: str, written: set[str], values: list[float]) -> bool:
    if number in written:
        return True
    digits = len(number.partition(".")[2])
    return any(number in (f"{value:.{digits}f}", f"{value:.4g}") for value in values)


def main() -> None:
    """Run the commands if asked, and write the pages."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--run", action="store_true", help="run the commands of the pages first")
    parser.add_argument("--only", action="append", default=[], help="commands or folders to run")
    arguments = parser.parse_args()
    quotes = Quotes.read()
    if arguments.run:
        keep_prints(quotes, arguments.only)
    write_page()
    write_pages()
    for page in PAGES:
        path = HOUSE / page
        text, lacking = renewed_page(path.read_text(encoding="utf-8"), quotes, page)
        path.write_text(text, encoding="utf-8")
        for line in lacking:
            print(f"{page} shows what is printed no longer: {line}")
        for each in strays(text, quotes.constants):
            print(f"{page} says {each}, which stands nowhere in the run")


if __name__ == "__main__":
    main()
