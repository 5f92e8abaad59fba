"""Kept machine code serves while its sources stay, and never longer."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from asbuilt import compilation, executor
from asbuilt.compilation import (
    Kernel,
    MachineCodeFiles,
    announce_kernels,
    compile_kernels,
    digest_sources,
    kernel,
)
from asbuilt.dynamics.kernels import rigid_body, single_sample  # noqa: F401
from asbuilt.experiment.signal import lowpass  # noqa: F401 - a usual kernel


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


def test_each_kernel_that_is_not_on_disk_is_announced_once(tmp_path: Path) -> None:
    seen = []
    with announce_kernels(seen.append):
        made = fresh_twice(tmp_path)
        assert made.is_on_disk()
        fresh_twice(tmp_path)
        other = tmp_path / "other"
        other.mkdir()
        second = fresh_twice(other)
    assert seen == [made, second]
    with announce_kernels(seen.append):
        fresh_twice(tmp_path)
    assert len(seen) == 2


def test_a_command_compiles_what_it_calls_and_the_usual_kernels_that_it_imports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Kernel, "is_on_disk", lambda self: False)
    wanted = single_sample.mass_matrix
    done = []

    class Workers:
        def run(self, function, tasks):
            done.extend(name for _, name in tasks)
            return iter(tasks)

    monkeypatch.setattr(executor, "open_workers", lambda count: nullcontext(Workers()))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    fractions = []
    compile_kernels(wanted, fractions.append)
    assert {"mass_matrix", "regressor", "newton_euler", "_filter_in_place"} <= {*done}
    assert not {"close_loops", "simulate", "sensitivities", "torque"} & {*done}
    assert fractions[0] == 0.0
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_processes_that_start_together_compile_a_kernel_once(tmp_path: Path) -> None:
    """The second waits for the lock of the first and loads what that one kept."""
    (tmp_path / "toy.py").write_text(
        "from asbuilt.compilation import kernel\n\n@kernel('i')\ndef twice(x):\n    return 2 * x\n"
    )
    program = (
        "import toy; assert toy.twice(3) == 6; print(sum(toy.twice.stats.cache_misses.values()))"
    )
    path = os.pathsep.join([str(tmp_path), str(compilation.PACKAGE.parent)])
    command = [sys.executable, "-c", program]
    environment = os.environ | {"PYTHONPATH": path}
    started = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert sum(int(process.communicate()[0]) for process in started) == 1
