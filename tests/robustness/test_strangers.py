"""Files of every kind, damaged twice over: each ends in one answer or one error of one line.

`test_corpus` and `test_every_file` damage one place; here several damages meet, numbers move by
powers of ten, names and lines change places, and meshes, archives and ledgers take part.
"""

from __future__ import annotations

import io
import random
import re
import signal
import struct
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from asbuilt.workflow import identify
from command_line import call
from fleet_logs import MODEL, content_of, recording, write_logs
from robustness import corpus
from robustness.test_every_file import CELL, MASSES, SDF, XACRO

pytestmark = [pytest.mark.study, pytest.mark.apps("fleet", "masses", "programs", "watch")]
SEED = 20_391
COMPUTING = 60.0
"""CPU time [s] after which a file counts as hung; the slowest takes about three."""
WORDS = ("", "nan", "-0", "1e309", "0x10", "١٢", "\u202e", "%s%n", "../..", "null", "0" * 400, "_")


@dataclass(frozen=True)
class Stranger:
    """A good file, the files beside it, and the command that reads it (`@` is its folder)."""

    name: str
    content: bytes
    command: tuple[str, ...]
    beside: dict[str, bytes]


def scale_number(text: str, rng: random.Random) -> str:
    """One number times a power of ten, or its opposite."""
    found = [*re.finditer(r"(?<![\w.])-?\d+(\.\d+)?(?![\w.])", text)]
    if not found:
        return text
    place = rng.choice(found)
    power = rng.choice((-300, -20, -9, -3, 3, 6, 9, 15, 40, 150, 290))
    new = rng.choice((f"{place[0]}e{power}", f"-{place[0].lstrip('-')}", f"{place[0]}{place[0]}"))
    return text[: place.start()] + new + text[place.end() :]


def replace_word(text: str, rng: random.Random) -> str:
    """One word by another of the file, or by one that no file has."""
    found = [*re.finditer(r"[A-Za-z_][\w-]*", text)]
    if not found:
        return text
    place = rng.choice(found)
    new = rng.choice((*WORDS, rng.choice(found)[0], rng.choice(found)[0]))
    return text[: place.start()] + new + text[place.end() :]


def move_lines(text: str, rng: random.Random) -> str:
    """Some lines to another place."""
    lines = text.splitlines(keepends=True)
    first = rng.randrange(len(lines) + 1)
    taken = lines[first : first + rng.randrange(1, 4)]
    rest = lines[:first] + lines[first + len(taken) :]
    at = rng.randrange(len(rest) + 1)
    return "".join(rest[:at] + taken + rest[at:])


def drop_span(text: str, rng: random.Random) -> str:
    """Everything between two marks of the language."""
    marks = [found.start() for found in re.finditer(r'[<>"\[\]{},=\n]', text)] or [0]
    first, last = sorted((rng.choice(marks), rng.choice(marks)))
    return text[:first] + text[min(last, first + 80) :]


WAYS = (scale_number, replace_word, move_lines, drop_span)


def spoil(content: bytes, rng: random.Random) -> bytes:
    """Return a file with one to three damages."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = ""
    if not text or rng.random() < 0.1:
        return next(data for _, data in corpus.damaged(content, rng, 1 + rng.randrange(5)))
    for _ in range(rng.randrange(1, 4)):
        text = rng.choice(WAYS)(text, rng)
    return text.encode("utf-8", "surrogatepass")


def write_meshes() -> dict[str, bytes]:
    """A tetrahedron as STL, binary and text, OBJ, PLY, OFF and 3MF."""
    corners = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    solid = bytes(80) + struct.pack("<I", 4)
    ascii_solid = "solid a\n"
    for face in faces:
        points = [corners[k] for k in face]
        solid += struct.pack("<12fH", 0, 0, 0, *(x for point in points for x in point), 0)
        loop = "".join("vertex {} {} {}\n".format(*point) for point in points)
        ascii_solid += f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n"
    rows = "".join("{} {} {}\n".format(*point) for point in corners)
    numbered = "".join("3 {} {} {}\n".format(*face) for face in faces)
    vertices = "".join('<vertex x="{}" y="{}" z="{}"/>\n'.format(*point) for point in corners)
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>\n'.format(*face) for face in faces)
    part = io.BytesIO()
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "3D/3dmodel.model",
            '<model unit="meter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
            f'<resources><object id="1" type="model"><mesh><vertices>{vertices}</vertices>'
            f'<triangles>{triangles}</triangles></mesh></object></resources>'
            '<build><item objectid="1"/></build></model>',
        )  # fmt: skip
    return {
        "binary.stl": solid,
        "text.stl": (ascii_solid + "endsolid a\n").encode(),
        "mesh.obj": (
            re.sub("^", "v ", rows, flags=re.M).removesuffix("v ")
            + "".join("f {} {} {}\n".format(*(k + 1 for k in face)) for face in faces)
        ).encode(),
        "mesh.ply": (
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty"
            " float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
            f"{rows}{numbered}"
        ).encode(),
        "mesh.off": f"OFF\n4 4 0\n{rows}{numbered}".encode(),
        "mesh.3mf": part.getvalue(),
    }


@cache
def write_ledger(folder: Path) -> dict[str, bytes]:
    """The files of a ledger of two logs."""
    from asbuilt.apps.fleet import FleetOptions, add_logs

    logs = write_logs(folder / "logs", 2)
    add_logs(folder / "ledger", MODEL, logs, robot_id="R1", fleet=FleetOptions(workers=0))
    return {f"ledger/{name}": data for name, data in content_of(folder / "ledger").items()}


def list_strangers(folder: Path) -> dict[str, Stranger]:
    """Return good files of every kind with their commands."""
    log = corpus.csv_log().encode()
    sheet = corpus.SHEET.encode()
    found = {
        f"robot{suffix}": Stranger(f"r{suffix}", text.encode(), ("show", f"@/r{suffix}"), {})
        for suffix, text in (*corpus.ROBOTS.items(), (".sdf", SDF), (".xacro", XACRO))
    }
    for suffix, data in (*corpus.binary_logs().items(), (".csv", log)):
        found[f"log{suffix}"] = Stranger(
            f"log{suffix}", data, ("check", "two-link", f"@/log{suffix}"), {}
        )
    for name, data in write_meshes().items():
        geometry = f'<visual><geometry><mesh filename="{name}"/></geometry></visual></link>'
        urdf = corpus.URDF.replace("</inertial></link>", f"</inertial>{geometry}").encode()
        found[name] = Stranger(name, data, ("masses", "@/r.urdf"), {"r.urdf": urdf})
    model = recording(3, seconds=6.0)
    result = identify(MODEL, [model])
    stored = result.to_json().encode()
    for command in ("show", "export --c @/o.c", "validate @/log.csv", "watch @/log.csv"):
        first, *rest = command.split()
        found[f"result, {first}"] = Stranger(
            "result.json", stored, (first, "@/result.json", *rest), {"log.csv": log}
        )
    for name, data in write_ledger(folder).items():
        kind = f"ledger, {Path(name).suffix}"
        beside = {other: each for other, each in write_ledger(folder).items() if other != name}
        found.setdefault(
            kind, Stranger(name, data, ("fleet", "identify", "@/ledger", "--id", "R1"), beside)
        )
    check = ("check", "two-link", "@/log.csv")
    return found | {
        "sheet": Stranger("log.toml", sheet, (*check, "--sheet", "@/log.toml"), {"log.csv": log}),
        "motion": Stranger(
            "m.csv",
            corpus.MOTION.encode(),
            ("program", "two-link", "@/m.csv", "--format", "csv", "-o", "@/p"),
            {},
        ),
        "cell": Stranger(
            "cell.toml",
            CELL.encode(),
            ("excite", "two-link", "--collision", "@/cell.toml", "--starts", "1", "--duration", "2",
             "--time", "1", "-o", "@/e.csv"),
            {},
        ),
        "masses": Stranger(
            "masses.csv",
            MASSES.replace("Ixx,Iyy", "Ixx [kg m^2],Iyy [kg m^2]").encode(),
            ("masses", "two-link", "--table", "@/masses.csv", "--about", "com", "--products",
             "tensor"),
            {},
        ),
    }  # fmt: skip


def describe_failure(capsys: pytest.CaptureFixture[str], words: list[str]) -> str | None:
    """Run a command; return what is neither an answer nor one error, None if nothing is."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"no end after {COMPUTING:g} s of computing")

    previous = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, COMPUTING)
    try:
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            status, out, err = call(capsys, *words)
    except BaseException as wrong:
        return f"{type(wrong).__name__} {str(wrong)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, previous)
    shown = [str(each.message) for each in seen if issubclass(each.category, RuntimeWarning)]
    if shown:
        return f"warns {shown[0]}"
    if "unexpected" in err or "Traceback" in err or len(err) > 4000:
        return err[-300:]
    if status not in (0, 1, 2):
        return f"status {status}"
    if status and err.count("asbuilt: ") != 1 and not (words[0] == "check" and out.strip()):
        return f"{err.count('asbuilt: ')} errors: {err[:300]}"
    return None


def failures(
    capsys: pytest.CaptureFixture[str], folder: Path, stranger: Stranger, seed: int, count: int
) -> Iterator[str]:
    """Yield what goes wrong with damaged copies of a file."""
    rng = random.Random(seed)
    for name, data in stranger.beside.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    place = folder / stranger.name
    place.parent.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        place.write_bytes(spoil(stranger.content, rng))
        words = [word.replace("@", str(folder)) for word in stranger.command]
        wrong = describe_failure(capsys, words)
        if wrong:
            kept = folder / f"kept_{number}{place.suffix}"
            kept.write_bytes(place.read_bytes())
            yield f"{kept}: {wrong}"


EACH = 14
KINDS = (
    *(f"robot{suffix}" for suffix in (*corpus.ROBOTS, ".sdf", ".xacro")),
    *(f"log{suffix}" for suffix in (".npz", ".mat", ".parquet", ".h5", ".db3", ".csv")),
    *("binary.stl", "text.stl", "mesh.obj", "mesh.ply", "mesh.off", "mesh.3mf"),
    *("result, show", "result, export", "result, validate", "result, watch"),
    *("ledger, .json", "ledger, .parquet", "sheet", "motion", "cell", "masses"),
)


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Stranger]:
    return list_strangers(tmp_path_factory.mktemp("good"))


def test_every_kind_takes_part(strangers: dict[str, Stranger]) -> None:
    assert set(strangers) == set(KINDS)
    assert len(KINDS) * EACH >= 300


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_twice(
    kind: str,
    strangers: dict[str, Stranger],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seed = SEED + KINDS.index(kind)
    assert not [*failures(capsys, tmp_path, strangers[kind], seed, EACH)]


@pytest.mark.parametrize("kind", KINDS)
def test_undamaged_is_read(
    kind: str,
    strangers: dict[str, Stranger],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stranger = strangers[kind]
    for name, data in (*stranger.beside.items(), (stranger.name, stranger.content)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    words = [word.replace("@", str(tmp_path)) for word in stranger.command]
    assert describe_failure(capsys, words) is None
