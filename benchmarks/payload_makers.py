"""A payload in the words of every maker, read back by parsers written from the makers' manuals.

    python benchmarks/payload_makers.py

One body, with all ten parameters, is written as `asbuilt payload --to` writes it. The parsers share
no line with the writers; rotations are SciPy's. The table has what is read: mass, centre, and how
far the matrix of inertia about the centre is from that of the body. Makers that take no products
are compared on the diagonal.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from asbuilt.writers import PAYLOAD_FORMATS, CarriedBody, write_payload

MASS = 1.8
CENTRE = np.array([0.03, -0.02, 0.09])
INERTIA = np.array([[0.011, 0.001, -0.0007], [0.001, 0.009, 0.0005], [-0.0007, 0.0005, 0.006]])
BODY = CarriedBody("ur10e", "tool0", MASS, 0.02, CENTRE, INERTIA)
Read = tuple[float, np.ndarray, np.ndarray]


def numbers(text: str) -> list[float]:
    return [float(each) for each in re.findall(r"-?\d+\.\d+", text)]


def symmetric(six: list[float]) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def code(text: str, comment: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith(comment))


def read_ur(text: str) -> Read:
    mass, *rest = numbers(code(text, "#"))
    return mass, np.array(rest[:3]), symmetric(rest[3:9])


def read_franka(text: str) -> Read:
    mass, *rest = numbers(code(text, "//"))
    return mass, np.array(rest[:3]), np.array(rest[3:]).reshape(3, 3).T


def read_kuka(text: str) -> Read:
    found = {
        part: {axis: float(x) for axis, x in re.findall(r"([XYZABC]) (-?[\d.]+)", inside)}
        for part, inside in re.findall(r"(CM|J) \{([^}]*)\}", text)
    }
    place = found["CM"]
    turned = Rotation.from_euler("ZYX", [place[each] for each in "ABC"], degrees=True).as_matrix()
    inertia = turned @ np.diag([found["J"][each] for each in "XYZ"]) @ turned.T
    mass = float(re.findall(r"\{M ([\d.]+)", text)[0])
    return mass, np.array([place[each] for each in "XYZ"]) / 1e3, inertia


def read_abb(text: str) -> Read:
    mass, x, y, z, q1, q2, q3, q4, *moments = numbers(code(text, "!"))
    turned = Rotation.from_quat([q2, q3, q4, q1]).as_matrix()
    return mass, np.array([x, y, z]) / 1e3, turned @ np.diag(moments) @ turned.T


def read_fanuc(text: str) -> Read:
    mass, *rest = numbers(code(text, "#"))
    # One kilogram of force is 9.80665 N, one of it times cm s^2 is 0.0980665 kg m^2.
    return mass, np.array(rest[:3]) / 100, np.diag(rest[3:]) * 0.0980665


def read_yaskawa(text: str) -> Read:
    mass, *rest = numbers(code(text, "#"))
    return mass, np.array(rest[:3]) / 1e3, np.diag(rest[3:])


def read_doosan(text: str) -> Read:
    mass, *rest = numbers(code(text, "#"))
    return mass, np.array(rest[:3]) / 1e3, symmetric(rest[3:])


READERS: dict[str, Callable[[str], Read]] = {
    "ur": read_ur, "franka": read_franka, "kuka": read_kuka, "abb": read_abb,
    "fanuc": read_fanuc, "yaskawa": read_yaskawa, "doosan": read_doosan,
}  # fmt: skip


def keep(maker: str) -> np.ndarray:
    """The inertia of the body that a maker takes."""
    return INERTIA if PAYLOAD_FORMATS[maker].has_products else np.diag(np.diagonal(INERTIA))


def main() -> None:
    """Print the table."""
    print(f"{'maker':<8}  {'mass kg':>8}  {'centre m':<22}  {'inertia off':>11}  products")
    with tempfile.TemporaryDirectory() as folder:
        for maker, read in READERS.items():
            files, _ = write_payload(BODY, {maker: Path(folder) / "payload.txt"})
            mass, centre, inertia = read(files[maker].read_text())
            off = np.abs(inertia - keep(maker)).max() / np.abs(INERTIA).max()
            place = ", ".join(f"{x:.4f}" for x in centre)
            products = "yes" if PAYLOAD_FORMATS[maker].has_products else "no"
            print(f"{maker:<8}  {mass:>8.5f}  {place:<22}  {off:>11.1e}  {products}")


if __name__ == "__main__":
    main()
