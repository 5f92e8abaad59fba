"""The documentation names existing commands, options and functions, and all of them."""

from __future__ import annotations

import ast
import inspect
import re
import shlex
from dataclasses import replace
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import typer

import asbuilt
from asbuilt.cli.app import app
from asbuilt.cli.commands import SUBCOMMANDS
from asbuilt.excitation import random_fourier
from asbuilt.experiment import VirtualRobot
from asbuilt.writers import write_recording, write_urdf

pytestmark = pytest.mark.apps(
    *("estimators", "fleet", "masses", "page", "paper", "programs", "simulators", "watch")
)
"""The documentation and the examples are of the whole distribution."""

HOUSE = Path(__file__).resolve().parents[1]
PAGES = [HOUSE / "README.md", *sorted((HOUSE / "docs").rglob("*.md"))]
GROUP: Any = typer.main.get_command(app)
COMMANDS = {
    name: GROUP.get_command(None, name)
    for name in GROUP.list_commands(None)
    if name not in SUBCOMMANDS
} | {
    f"{name} {sub}": GROUP.get_command(None, name).get_command(None, sub)
    for name, entries in SUBCOMMANDS.items()
    for sub in entries
}
OPTIONS = {
    name: [
        {*parameter.opts, *parameter.secondary_opts}
        for parameter in command.params
        if parameter.param_type_name == "option"
    ]
    for name, command in COMMANDS.items()
}
"""The names of every option of every command."""
GENERATED = {"--full", "--duration"}
"""Options of the programs that `asbuilt program` writes."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def command_lines() -> list[tuple[str, str]]:
    lines = [
        (page.name, line)
        for page in PAGES
        for block in blocks(page, "(?:sh|bash|console)?")
        for line in block.replace("\\\n", "").splitlines()
    ]
    lines = [(page, line.removeprefix("$ ")) for page, line in lines]
    return [(page, line) for page, line in lines if re.match(r"asbuilt [a-z]+( |$)", line)]


def python_blocks() -> list[tuple[str, str]]:
    pages = [page for page in PAGES if page.name != "tutorial.md"]
    return [(page.name, block) for page in pages for block in blocks(page, "python")]


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_commands_can_be_typed(page: str, line: str) -> None:
    _, name, *arguments = shlex.split(
        line.translate({ord(bracket): None for bracket in "[]"}), comments=True
    )
    if name in SUBCOMMANDS:
        name, arguments = f"{name} {arguments[0]}", arguments[1:]
    with COMMANDS[name].make_context(name, arguments):
        pass


@pytest.mark.parametrize(("page", "block"), python_blocks())
def test_python_blocks_use_existing_names(page: str, block: str) -> None:
    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.ImportFrom):
            module = import_module(str(node.module))
            for alias in node.names:
                assert hasattr(module, alias.name), f"{page}: {node.module} has no {alias.name}"
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "asbuilt"
        ):
            assert hasattr(import_module("asbuilt"), node.attr), (
                f"{page}: asbuilt has no {node.attr}"
            )


@pytest.fixture(scope="module")
def at_hand(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what the pages use: a robot and its file, recordings and their files, results."""
    folder = tmp_path_factory.mktemp("pages")
    model = asbuilt.load_robot("ur10e")
    write_urdf(folder / "arm.urdf", model)
    robot = VirtualRobot.typical(model, rng=1)
    recordings = [
        robot.record(random_fourier(model, rng=seed, duration=12.0), rate=100.0, rng=seed).recording
        for seed in (2, 3)
    ]
    tool = asbuilt.LinkInertia.from_com(
        2.0, [0.0, 0.0, 0.05], [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]
    )
    motion = random_fourier(model, rng=4, duration=12.0)
    loaded = robot.with_tool(tool).record(motion, rate=100.0, rng=4).recording
    recordings = [replace(each, extra={"tau_ext": 0.1 * each.tau}) for each in recordings]
    write_recording(folder / "hour.parquet", recordings[0])
    write_recording(folder / "timed.csv", recordings[0])
    pl.read_csv(folder / "timed.csv").drop("t").write_csv(folder / "log.csv")
    samples, other = (asbuilt.prepare_samples(each) for each in recordings)
    drive = asbuilt.DriveSet.parse("viscous,coulomb,offset")
    options = asbuilt.StudyOptions(drive=drive, method="consistent")
    studies = [asbuilt.identify(model, [each], options=options) for each in recordings]
    return {
        "folder": folder,
        "model": model,
        "recording": recordings[0],
        "loaded": loaded,
        "samples": samples,
        "other": other,
        "result": studies[0].result,
        "in_january": studies[0].result,
        "in_july": studies[1].result,
        "training": studies[0].training[0],
        "held_out": studies[1].training[0],
    }


LONG = ("design_motion(", "MeshPart(", "link_masses(")
"""Calls that take minutes or need meshes; they are tested elsewhere."""
STUDIES = ("fleet_identify(", "write_report(", "Loop(")
"""Calls that take seconds."""


@pytest.mark.parametrize(
    ("page", "block"),
    [
        pytest.param(
            *found, marks=[pytest.mark.study] if any(call in found[1] for call in STUDIES) else []
        )
        for found in python_blocks()
        if not any(call in found[1] for call in LONG)
    ],
)
def test_python_blocks_run(
    page: str, block: str, at_hand: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    block = block.replace("rate=1000)", "rate=100)") if "log.csv" in block else block
    monkeypatch.chdir(at_hand["folder"])
    names = {name: value for name, value in at_hand.items() if name != "folder"}
    exec(compile(block, page, "exec"), names)


def test_every_command_and_option_is_documented() -> None:
    documented = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [name for name in COMMANDS if f"asbuilt {name}" not in documented] == []
    words = set(re.findall(r"--[a-z][a-z-]*", documented))
    assert {
        name: [names for names in options if not names & words] for name, options in OPTIONS.items()
    } == {name: [] for name in OPTIONS}


def test_commands_that_read_logs_have_the_same_options() -> None:
    reading = {"--rate", "--flip-torque", "--gain", "--torque-source", "--sheet"}
    filtering = {"--cutoff", "--decimate", "--preset"}
    for name in ("check", "identify", "validate", "compare", "payload", "gains", "channels"):
        documented = set().union(*OPTIONS[name])
        assert reading <= documented
        assert filtering <= documented or name in {"check", "compare"}


def test_options_in_the_documentation_exist() -> None:
    known = GENERATED.union(
        {"--help", "--version", "--install-completion"},
        *(names for options in OPTIONS.values() for names in options),
    )
    for page in PAGES:
        for code in re.findall(r"`([^`\n]*--[a-z][^`\n]*)`", page.read_text(encoding="utf-8")):
            if "asbuilt" in code or code.startswith("--"):
                assert set(re.findall(r"(?<!\S)--[a-z][a-z-]*", code)) <= known, (
                    f"{page.name}: `{code}`"
                )


def test_formulas_are_written_as_the_pages_render_them() -> None:
    assert [
        page.name for page in PAGES if re.search(r"\\[(\[]", page.read_text(encoding="utf-8"))
    ] == []


def test_code_in_tables_has_no_escaped_bars() -> None:
    """GitHub requires bars in tables to be escaped, and the pages would show the escape."""
    shown = {
        page.name: re.findall(r"`[^`\n]*\\\|[^`\n]*`", page.read_text(encoding="utf-8"))
        for page in PAGES
    }
    assert {name: code for name, code in shown.items() if code} == {}


def described_names() -> list[str]:
    """The names whose docstrings the pages of the Python interface show."""
    pages = sorted((HOUSE / "docs" / "reference" / "api").glob("*.md"))
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    return re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)


def test_the_reference_is_what_the_code_says() -> None:
    """Every option of every command, and a page a stage; `docs/build_reference.py` renews them."""
    spec = spec_from_file_location("build_reference", HOUSE / "docs" / "build_reference.py")
    assert spec is not None
    assert spec.loader is not None
    builder = module_from_spec(spec)
    spec.loader.exec_module(builder)
    for name, text in builder.build_pages().items():
        kept = (HOUSE / "docs" / "reference" / name).read_text(encoding="utf-8")
        assert kept == text, f"{name} is old: python docs/build_reference.py"
    manual = (HOUSE / "docs" / "reference" / "cli.md").read_text(encoding="utf-8")
    for name, options in OPTIONS.items():
        _, heading, below = manual.partition(f"### `asbuilt {name}`\n")
        section = below.partition("\n### ")[0]
        own = [names for names in options if not names & builder.ON_ALL]
        listed = set(re.findall(r"--[a-z][a-z-]*", section))
        assert [names for names in own if not names & listed] == [], name
        assert heading or own == []


def test_every_page_is_listed_and_the_menu_is_short() -> None:
    docs = HOUSE / "docs"
    menu = (HOUSE / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    entries = set(re.findall(r"[\w/-]+\.(?:md|ipynb)$", menu, re.MULTILINE)) - {"pages.md"}
    listed = set(re.findall(r"\]\(([^)]+)\)", (docs / "pages.md").read_text(encoding="utf-8")))
    own = {"index.md", "pages.md"}
    pages = {str(page.relative_to(docs)) for page in docs.rglob("*.md")} - own
    below = {page for page in pages if page.startswith(("robots/", "reference/api/", "built/"))}
    assert len(entries) <= 30
    assert entries - {"index.md"} <= listed
    assert pages - below <= listed


def test_the_python_interface_is_what_asbuilt_exports() -> None:
    documented = [name.rpartition(".")[2] for name in described_names()]
    assert sorted(documented) == sorted(asbuilt._list_all_names())


def test_examples_in_docstrings_have_a_heading() -> None:
    """Without a heading the page shows `>>>` as quotations within each other."""
    for name in described_names():
        module, _, thing = name.rpartition(".")
        found = getattr(import_module(module), thing)
        own = [found, *vars(found).values()] if isinstance(found, type) else [found]
        for text in (
            inspect.getdoc(each) or ""
            for each in own
            if callable(each) or isinstance(each, property | classmethod)
        ):
            assert ">>>" not in text.partition("\nExamples\n--------\n")[0], name


def test_the_comparison_is_whole_dated_and_cited() -> None:
    """Each feature has a word for every tool, and each tool a source that was read."""
    text = (HOUSE / "docs/compare.md").read_text("utf-8")
    table, sources = text.partition("## The table")[2].split("## Sources")
    rows = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("|")]
    tools = [cell.strip() for cell in rows[0][1:]]
    features = [row for row in rows[2:] if not row[0].strip().startswith("**")]
    assert len(features) >= 50
    assert not [row[0] for row in rows if len(row) != len(tools) + 1]
    assert not [row[0] for row in features if not all(cell.strip() for cell in row)]
    cited = [line for line in sources.splitlines() if line.startswith("| ")]
    for tool in tools[1:]:
        assert any(line.startswith(f"| {tool} ") and "](http" in line for line in cited), tool
    assert re.search(r"As of \d+ \w+ 20\d\d", text)
    lacking = [row[0] for row in features if row[1].strip() == "–"]
    assert len(lacking) >= 5, "what peers have and this tool lacks stands there too"
