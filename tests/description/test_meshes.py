"""Meshes of strangers are read with limits, in one process for all that a command reads."""

from __future__ import annotations

import os
import resource
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from asbuilt.description import measure_mesh
from asbuilt.errors import DescriptionError
from asbuilt.isolated_reading import _idle

trimesh = pytest.importorskip("trimesh")
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def write_sparse_stl(path: Path, size: int) -> Path:
    """A binary STL that declares the triangles of its size, of which nothing lies on the disk."""
    with path.open("wb") as stream:
        stream.write(bytes(80) + struct.pack("<I", (size - 84) // 50))
        stream.truncate(size)
    return path


@pytest.mark.parametrize(
    ("size", "said"),
    [(8_000_000_000, "has 8000 MB; at most 200 MB"), (40_000_000, "no finite triangles")],
)
def test_a_sparse_mesh_is_one_error_in_bounded_memory(tmp_path: Path, size: int, said: str) -> None:
    path = write_sparse_stl(tmp_path / "sparse.stl", size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DescriptionError, match=said):
        measure_mesh(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


def test_a_mesh_that_declares_more_than_it_has(tmp_path: Path) -> None:
    path = tmp_path / "declares.stl"
    path.write_bytes(bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(200))
    with pytest.raises(DescriptionError, match=r"declares\.stl"):
        measure_mesh(path)


def test_an_archive_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    pytest.importorskip("networkx")
    pytest.importorskip("lxml")
    path = tmp_path / "bomb.3mf"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("3D/3dmodel.model", "w", force_zip64=True) as part,
    ):
        part.write(b"<model>")
        for _ in range(600):
            part.write(bytes(1_000_000))
    with pytest.raises(DescriptionError, match=r"bomb\.3mf needs more than 5\d\d MB to read"):
        measure_mesh(path)


def test_no_material_is_read_beside_a_mesh(tmp_path: Path) -> None:
    path = tmp_path / "endless.obj"
    path.write_text(f"mtllib /dev/zero\nusemtl a\n{TRIANGLE}")
    with pytest.raises(DescriptionError, match="encloses no volume"):
        measure_mesh(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    with pytest.raises(DescriptionError, match="not a regular file"):
        measure_mesh(tmp_path / "pipe.stl")


@pytest.mark.parametrize("length", [1e308, 1e160, 1e60, 1e-300])
def test_coordinates_that_no_part_has_are_one_error(tmp_path: Path, length: float) -> None:
    path = tmp_path / "huge.obj"
    corners = length * np.vstack([np.zeros(3), np.eye(3)])
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + faces)
    with pytest.raises(DescriptionError, match=r"m long; check the unit|no finite|no volume"):
        measure_mesh(path)


def test_one_process_reads_all_meshes_of_a_command(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "box.stl")
    readers = set()
    for _ in range(5):
        measured = measure_mesh(tmp_path / "box.stl")
        readers |= {child._process.pid for child in _idle}
    assert len(readers) == 1
    assert os.getpid() not in readers
    assert measured.closed
    assert measured.inertia.mass == pytest.approx(0.1 * 0.2 * 0.3, rel=1e-6)
