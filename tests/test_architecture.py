"""The import law: a stage imports itself, the stages that sort before it, and the leaf modules.

The command line may import any stage. Nothing of these, the core, imports an app; an app imports
public names.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from types import FunctionType
from typing import Any, get_origin

import pytest
import typer

import asbuilt
from parsed_source import SOURCE, nodes_of

STAGES = (
    "description",
    "dynamics",
    "excitation",
    "experiment",
    "identification",
    "validation",
    "workflow",
    "writers",
)
LEAVES = (
    "arrays",
    "children",
    "codec",
    "compilation",
    "errors",
    "executor",
    "findings",
    "isolated_reading",
    "isolation",
    "ranges",
    "registry",
    "scaled",
    "statistics",
    "tables",
    "untrusted",
    "writing",
)
APPS = sorted(path.parent.name for path in SOURCE.glob("apps/*/__init__.py"))
"""Apps that are there: the core is tested without any, too."""
FACES = ("asbuilt", "asbuilt.cli", *(f"asbuilt.{stage}" for stage in STAGES))
"""Packages of the core whose stub lists what is public."""
FULL = 25
"""Modules that one folder may hold."""
HEAVY = (
    "numba",
    "scipy",
    "polars",
    "matplotlib",
    "clarabel",
    "trimesh",
    "mujoco",
    "pydantic",
    "lxml",
)
USED_LATER = (
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "scipy.interpolate",
    "scipy.io",
    "clarabel",
    "matplotlib",
    "plotly",
)
"""Packages that are imported once a robot and its recordings have been read."""


@cache
def imported_modules(path: Path) -> list[str]:
    """Names below `asbuilt.` that a file imports, anywhere in it."""
    names: list[str] = []
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [
                f"{node.module}.{alias.name}" if node.module == "asbuilt" else str(node.module)
                for alias in node.names
            ]
    return [
        name.removeprefix("asbuilt.")
        for name in names
        if name == "asbuilt" or name.startswith("asbuilt.")
    ]


def foreign_packages(path: Path) -> set[str]:
    """Packages beside the standard library and asbuilt that a file imports, by statement or by
    `import_module`.
    """
    names: list[str] = []
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append(str(node.module))
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == "import_module"
            and isinstance(node.args[0], ast.Constant)
        ):
            names.append(node.args[0].value)
    return {name.split(".")[0] for name in names} - sys.stdlib_module_names - {"asbuilt"}


def test_stages_are_what_the_law_knows() -> None:
    folders = {p.name for p in SOURCE.iterdir() if p.is_dir()} - {"__pycache__", "apps"}
    assert folders == {"cli", *STAGES}
    assert tuple(sorted(STAGES)) == STAGES


@pytest.mark.parametrize("stage", STAGES)
def test_stage_imports_only_itself_earlier_stages_and_leaves(stage: str) -> None:
    allowed = {*LEAVES, *STAGES[: STAGES.index(stage) + 1]}
    for path in (SOURCE / stage).rglob("*.py"):
        for name in imported_modules(path):
            assert name.split(".")[0] in allowed, (
                f"{path.relative_to(SOURCE)} imports asbuilt.{name}"
            )


@pytest.mark.parametrize("leaf", LEAVES)
def test_leaf_imports_leaves_only(leaf: str) -> None:
    assert {name.split(".")[0] for name in imported_modules(SOURCE / f"{leaf}.py")} <= set(LEAVES)


def list_core() -> list[Path]:
    """Files of the core."""
    return [path for path in SOURCE.rglob("*.py") if SOURCE / "apps" not in path.parents]


def test_core_imports_no_app() -> None:
    """Neither when it is loaded, nor later, nor by a name of `asbuilt` that an app owns."""
    owned = {name for name, home in public_names("asbuilt").items() if ".apps." in home}
    for path in list_core():
        names = {name.split(".")[0] for name in imported_modules(path)}
        for node in nodes_of(path):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                names |= {node.attr} if node.value.id == "asbuilt" else set()
        named = names & {"apps", *owned}
        assert not named, f"{path.relative_to(SOURCE)} imports {', '.join(named)}"


def test_core_names_apps_where_it_looks_for_them_alone() -> None:
    known = {"registry.py": "asbuilt.apps"}
    for path in list_core():
        place = path.relative_to(SOURCE).as_posix()
        for text in texts_of(path):
            assert "asbuilt.apps" not in text or text == known.get(place), f"{place}: {text!r}"


def test_stages_have_no_names_of_apps() -> None:
    for face in FACES[1:]:
        for home in public_names(face).values():
            assert not home.startswith("asbuilt.apps."), home


def imported_names(path: Path) -> list[tuple[str, str]]:
    """Package or module and name of everything of `asbuilt` that a file imports or reads of it."""
    names: list[tuple[str, str]] = []
    packages: dict[str, str] = {}
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "asbuilt":
            names += [(str(node.module), alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            imported = [a.name for a in node.names if a.name.split(".")[0] == "asbuilt"]
            packages |= {name: name for name in imported}
            # `import asbuilt.stage.inside` reaches as far as `from asbuilt.stage import inside`.
            names += [
                (home, name) for home, dot, name in (i.rpartition(".") for i in imported) if dot
            ]
    packages |= {name: f"asbuilt.{name}" for home, name in names if home == "asbuilt"}
    for node in nodes_of(path):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            package = packages.get(node.value.id)
            if package in FACES:
                names.append((package, node.attr))
    return names


def list_used_apps(app: str) -> set[str]:
    """Other apps that an app may import: those of a line `Uses: NAME, NAME.` of its docstring."""
    text = (SOURCE / "apps" / app / "__init__.py").read_text()
    line = re.search(r"^Uses: (.*)\.$", text, re.MULTILINE)
    return set() if line is None else set(line[1].split(", "))


@pytest.mark.parametrize("app", APPS)
def test_app_imports_public_names_only(app: str) -> None:
    """None that is also a module of its stage, which would hide it, and none of another app.

    `asbuilt` exposes names of all apps: those of others are no more public than their modules.
    """
    home = SOURCE / "apps" / app
    own = {app, *list_used_apps(app)}
    leaves = {f"asbuilt.{leaf}" for leaf in LEAVES}
    public = {face: set(public_names(face)) for face in FACES}
    public["asbuilt"] |= {
        "__version__",
        *LEAVES,
        *(face.removeprefix("asbuilt.") for face in FACES),
    }
    for name, owner in public_names("asbuilt").items():
        if owner.startswith("asbuilt.apps.") and owner.split(".")[2] not in own:
            public["asbuilt"].remove(name)
    for path in home.rglob("*.py"):
        for package, name in imported_names(path):
            place = f"{path.relative_to(SOURCE)}: {package}.{name}"
            if package in leaves or package in (f"asbuilt.apps.{app}", "asbuilt.apps"):
                continue
            if package.startswith("asbuilt.apps."):
                assert package.split(".")[2] in own, f"{place}, of another app"
                continue
            assert package in public, f"{place}, of an inside"
            assert name in public[package], f"{place} is not public"
            inside = SOURCE.joinpath(*package.split(".")[1:], f"{name}.py")
            assert package == "asbuilt" or not inside.exists(), f"{place}, also a module"


def test_every_app_imports_into_its_commands_only_what_is_there() -> None:
    from asbuilt.cli.commands import ABSENT, EVERY_COMMAND, TABLE

    named = {app for group in TABLE.values() for app in group.values() if isinstance(app, str)}
    assert named - set(APPS) == set(ABSENT.values())
    for name, entry in EVERY_COMMAND.items():
        assert (SOURCE / entry.module.replace(".", "/")).with_suffix(".py").is_file(), name


def test_no_folder_is_crowded() -> None:
    for folder in {path.parent for path in SOURCE.rglob("*.py")} - {SOURCE}:
        modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= FULL, f"{folder}: {sorted(modules)}"


def test_no_module_imports_in_a_circle() -> None:
    names = {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts): path
        for path in SOURCE.rglob("*.py")
        if path.name != "__init__.py"
    }
    imports = {name: set(imported_modules(path)) & set(names) for name, path in names.items()}
    TopologicalSorter(imports).prepare()


def test_every_package_that_is_imported_is_declared() -> None:
    """What only comes along with another package may go with its next version."""
    project = tomllib.loads((SOURCE.parents[1] / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(
            each
            for extra in ("sim", "bags", "hdf5", "cad", "view", "rerun", "cluster", "robots", "s3")
            for each in project["optional-dependencies"][extra]
        ),
    ]
    declared = {re.split(r"[<>=\[]", each)[0].replace("-", "_").lower() for each in wanted}
    distributions = packages_distributions()
    for path in SOURCE.rglob("*.py"):
        for name in foreign_packages(path):
            homes = {home.replace("-", "_").lower() for home in distributions.get(name, [name])}
            assert homes & declared, (
                f"{path.relative_to(SOURCE)} imports {name} of {', '.join(homes)}, which"
                " pyproject.toml does not name"
            )


def public_names(package: str) -> dict[str, str]:
    """Public names of a package and the module that owns each, from its stub."""
    stub = SOURCE.joinpath(*package.split(".")[1:], "__init__.pyi")
    names: dict[str, str] = {}
    for node in ast.parse(stub.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            assert node.level == 1
            for alias in node.names:
                assert alias.asname == alias.name, f"{stub}: write {alias.name} as {alias.name}"
                names[alias.name] = f"{package}.{node.module}"
    return names


def is_installed(module: str) -> bool:
    """Whether a module belongs to no app, or to one that is there."""
    parts = module.split(".")
    return parts[1] != "apps" or parts[2] in APPS


@pytest.mark.parametrize(
    "package",
    [
        *FACES,
        *(f"asbuilt.apps.{app}" for app in APPS if (SOURCE / f"apps/{app}/__init__.pyi").exists()),
    ],
)
def test_public_names_load_from_the_modules_of_the_stub(package: str) -> None:
    loaded, names = import_module(package), public_names(package)
    names = {name: home for name, home in names.items() if is_installed(home)}
    if package == "asbuilt":
        assert set(loaded.__all__) < set(names)  # what one needs; the rest is in the stages
        assert set(loaded.__all__) <= set(dir(loaded))
    else:
        assert loaded.__all__ == sorted(names)
    for name, home in names.items():
        value = getattr(loaded, name)
        assert getattr(import_module(home), name) is value
        assert value.__doc__ or get_origin(value) is not None, f"{name} has no docstring"
        if isinstance(value, type | FunctionType):
            assert value.__module__ == home


def test_stage_names_that_asbuilt_exposes_are_public_in_their_stage() -> None:
    for name, home in public_names("asbuilt").items():
        if home.split(".")[1] in (*STAGES, "cli"):
            assert public_names(".".join(home.split(".")[:2])).get(name) == home, name


def test_version_is_one() -> None:
    project = SOURCE.parents[1]
    declared = tomllib.loads((project / "pyproject.toml").read_text())["project"]["version"]
    assert asbuilt.__version__ == declared
    assert f"version: {declared}\n" in (project / "CITATION.cff").read_text()


@pytest.mark.parametrize(
    "statement", ["import asbuilt", "import asbuilt.cli.app; asbuilt.cli.app.main(['--help'])"]
)
def test_start_up_loads_nothing_heavy(statement: str) -> None:
    code = (
        f"import sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\nprint(*[m for m in"
        f" {HEAVY!r} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == ""


REFUSED = (
    ("robots", 0),
    ("show ur10e", 0),
    ("check ur10e LOG", 1),
    ("identify ur10e LOG", 1),
    ("identify ur10e LOG --validate LOG2 --payload LOG3", 1),
    ("gains ur10e LOG --loaded LOG2 --mass 1", 1),
    ("channels ur10e LOG --motor LOG2", 1),
    ("review ur10e LOG", 1),
    ("validate ur10e LOG", 1),
    ("excite LOG", 1),
    ("simulate ur10e --preset unknown", 2),
    ("simulate ur10e --tool heavy", 2),
    ("program LOG LOG2 --format franka", 1 if "programs" in APPS else 2),
)
"""Commands and their exit status."""


def test_bad_input_is_refused_before_anything_heavy_is_loaded(tmp_path: Path) -> None:
    """All commands run in one process; the first that loads a package is the one that is named."""
    for k, name in enumerate(("LOG", "LOG2", "LOG3")):
        (tmp_path / f"{name}.csv").write_text(f"t,q_1,tau_1\n0,1,{k}\n0.1,x,2\n")
    code = (
        "import json, sys\nfrom asbuilt.cli.app import main\nfor line in sys.argv[1:]:\n"
        "    try:\n        status = main(line.split())\n"
        "    except SystemExit as end:\n        status = end.code\n"
        f"    loaded = [m for m in {USED_LATER!r} if m in sys.modules]\n"
        "    print('RESULT', json.dumps([line, status, loaded]))"
    )
    lines = [re.sub(r"\b(LOG\d?)\b", r"\1.csv", line) for line, _ in REFUSED]
    done = subprocess.run(
        [sys.executable, "-c", code, *lines],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.findall(r"^RESULT (.*)$", done.stdout, re.MULTILINE)
    expected = [[line, end, []] for line, (_, end) in zip(lines, REFUSED, strict=True)]
    assert [json.loads(each) for each in found] == expected, done.stderr


def option_spellings() -> set[str]:
    """Every option of the command line."""
    from asbuilt.cli.app import app
    from asbuilt.cli.commands import COMMANDS, SUBCOMMANDS

    group: Any = typer.main.get_command(app)
    context = group.make_context("asbuilt", ["robots"], resilient_parsing=True)
    commands = [group.get_command(context, name) for name in COMMANDS]
    for name, entries in SUBCOMMANDS.items():
        inner = group.get_command(context, name)
        commands += [inner.get_command(context, each) for each in entries]
    params = [p for command in commands for p in command.get_params(context)]
    return {name for param in params for name in param.opts if name.startswith("--")}


def texts_of(path: Path) -> list[str]:
    """Texts in a file that are neither docstrings nor spellings (`also`) of an option."""
    nodes, skipped = nodes_of(path), set[int]()
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(id(node.value))
        elif isinstance(node, ast.keyword) and node.arg == "also":
            skipped |= {id(child) for child in ast.walk(node.value)}
    return [
        node.value
        for node in nodes
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in skipped
    ]


def test_library_code_names_no_option_of_the_command_line() -> None:
    """Advice is data (`Cure`), to which the command line adds the spelling of its options.

    Excepted are controller programs, which have options of their own, and the field `option` of
    the JSON of `gains`.
    """
    options = option_spellings()
    for path in SOURCE.rglob("*.py"):
        place = path.relative_to(SOURCE).as_posix()
        spells = place.startswith(("cli/", "apps/programs/", "apps/page/"))
        if spells or path.name in {"command.py", "commands.py", "demo.py", "drive_tables.py"}:
            continue
        for text in texts_of(path):
            named = options & set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))
            assert not named, f"{place} names {', '.join(sorted(named))}: {text!r}"
