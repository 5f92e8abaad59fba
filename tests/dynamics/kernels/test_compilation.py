"""Kept machine code serves while its sources stay, and never longer."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest
from numba.core.caching import IndexDataCacheFile

from asbuilt.dynamics.kernels import compilation
from asbuilt.dynamics.kernels.compilation import MachineCodeFiles, compiled, source_digest


def fresh_twice(folder: Path):
    """Import a compiled function anew, as another run would."""
    path = folder / "toy.py"
    path.write_text(
        "from asbuilt.dynamics.kernels.compilation import compiled\n\n@compiled\ndef twice(x):\n   "
        " return 2 * x\n"
    )
    specification = importlib.util.spec_from_file_location("toy", path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    assert module.twice(3) == 6
    return module.twice


def test_code_is_kept_until_a_source_beside_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sum(fresh_twice(tmp_path).stats.cache_hits.values()) == 0
    assert sum(fresh_twice(tmp_path).stats.cache_hits.values()) == 1
    monkeypatch.setattr(compilation, "source_digest", lambda folder: "another")
    assert sum(fresh_twice(tmp_path).stats.cache_hits.values()) == 0
    assert sum(fresh_twice(tmp_path).stats.cache_hits.values()) == 1


@pytest.mark.parametrize(
    "name",
    [
        "lanes.py",
        "recursion.py",
        "rigid_body.py",
        "joint_space.py",
        "regressor_adjoint.py",
        "compilation.py",
    ],
)
def test_every_source_of_kernels_counts_and_no_other(tmp_path: Path, name: str) -> None:
    folders = []
    for changed in ("nothing.py", name, "newton_euler.py"):
        folder = tmp_path / changed
        shutil.copytree(
            Path(compilation.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__")
        )
        with (folder / changed).open("a") as file:
            file.write("# a change\n")
        folders.append(folder)
    as_it_is, changed, elsewhere = map(source_digest, folders)
    assert changed != as_it_is
    assert elsewhere == as_it_is


def test_a_function_that_cannot_be_cached_is_compiled_all_the_same():
    namespace = {}
    exec("def twice(x):\n    return 2 * x", namespace)
    assert compiled(namespace["twice"])(3) == 6


@pytest.mark.parametrize("step", ["_save_index", "_save_data"])
def test_two_processes_that_compile_at_once_each_find_their_own_code(
    tmp_path: Path, step: str
) -> None:
    """Both have read the empty index; the second writes before a step of the first."""
    one, other, later = (
        MachineCodeFiles(IndexDataCacheFile(str(tmp_path), "twice-1.py3", "stamp"), "sources")
        for _ in range(3)
    )
    other._load_index = dict
    write = getattr(one, step)

    def overtaken(*given):
        other.save("of floats", b"code of floats")
        write(*given)

    setattr(one, step, overtaken)
    one.save("of integers", b"code of integers")
    assert later.load("of integers") in (None, b"code of integers")
    assert later.load("of floats") in (None, b"code of floats")
    for key in ("of integers", "of floats"):
        later.save(key, f"code {key}".encode())
    assert [later.load(key) for key in ("of integers", "of floats")] == [
        b"code of integers",
        b"code of floats",
    ]


def test_no_process_loads_code_of_other_sources_while_new_code_is_written(tmp_path: Path) -> None:
    def kept(sources):
        index = IndexDataCacheFile(str(tmp_path), "twice-1.py3", "stamp")
        return MachineCodeFiles(index, sources)

    old, new, reader = kept("old"), kept("new"), kept("new")
    old.save("of floats", b"old code")
    seen = []
    for step in ("_save_index", "_save_data"):
        write = getattr(new, step)

        def looked_at(*given, write=write):
            write(*given)
            seen.append(reader.load("of floats"))

        setattr(new, step, looked_at)
    new.save("of floats", b"new code")
    assert seen == [None, b"new code"]
    assert old.load("of floats") is None
    assert len([*tmp_path.glob("*.nbc")]) == 1
