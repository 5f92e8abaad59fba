"""Kept machine code serves while its sources stay, and never longer."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from asbuilt import compilation
from asbuilt.compilation import (
    Kernel,
    MachineCodeFiles,
    announce_kernels,
    compile_kernels,
    digest_sources,
    kernel,
)


def fresh_twice(folder: Path):
    """Import a compiled function anew, as another run would."""
    path = folder / "toy.py"
    path.write_text(
        "from asbuilt.compilation import kernel\n\n@kernel('i')\ndef twice(x):\n    return 2 * x\n"
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
    monkeypatch.setattr(compilation, "digest_sources", lambda folder: "another")
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
    ],
)
def test_every_source_of_kernels_counts_and_no_other(tmp_path: Path, name: str) -> None:
    folders = []
    for changed in ("nothing.py", name, "newton_euler.py"):
        folder = tmp_path / changed
        shutil.copytree(
            compilation.SHARED_PARTS, folder, ignore=shutil.ignore_patterns("__pycache__")
        )
        with (folder / changed).open("a") as file:
            file.write("# a change\n")
        folders.append(folder)
    as_it_is, changed, elsewhere = map(digest_sources, folders)
    assert changed != as_it_is
    assert elsewhere == as_it_is


def test_a_function_that_cannot_be_cached_is_compiled_all_the_same():
    namespace = {}
    exec("def twice(x):\n    return 2 * x", namespace)
    made = kernel("i")(namespace["twice"])
    assert made(3) == 6
    assert not made.is_kept


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


def test_a_kernel_has_one_signature_and_refuses_other_types() -> None:
    @kernel("f1 F1")
    def double(x, out):
        for k in range(x.size):
            out[k] = 2.0 * x[k]

    x, out = np.arange(3.0), np.zeros(3)
    with pytest.raises(TypeError, match="No matching definition"):
        double(np.arange(3), out)
    double(x, out)
    x.setflags(write=False)
    double(x, out)
    np.testing.assert_array_equal(out, [0.0, 2.0, 4.0])
    for wrong in (np.arange(3), np.arange(6.0)[::2], x.astype(np.float32)):
        with pytest.raises(TypeError, match="No matching definition"):
            double(wrong, out)
    with pytest.raises(TypeError, match="No matching definition"):
        double(out, x)
    assert len(double.overloads) == 1


def test_only_the_first_kernel_that_is_not_on_disk_is_announced(tmp_path: Path) -> None:
    seen = []
    with announce_kernels(seen.append):
        made = fresh_twice(tmp_path)
        assert made.is_on_disk()
        fresh_twice(tmp_path)
    assert seen == [made]
    with announce_kernels(seen.append):
        fresh_twice(tmp_path)
    assert seen == [made]


def test_every_module_with_kernels_is_found_and_each_has_its_own_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done = []
    monkeypatch.setattr(Kernel, "is_on_disk", lambda self: self.py_func.__module__ == "toy")
    monkeypatch.setattr(Kernel, "make_ready", lambda self: done.append(self.__name__))
    fractions = []
    compile_kernels(fractions.append)
    assert {
        "regressor",
        "newton_euler",
        "simulate",
        "write_lag",
        "_search_closest_points",
        "_follow",
    } <= set(done)
    assert fractions[0] == 0.0
    assert fractions == sorted(fractions)
    assert fractions[-1] < 1.0
