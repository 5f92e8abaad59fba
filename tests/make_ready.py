"""Compile once, all cores at it, what each process that tests would compile for itself.

    python tests/make_ready.py

Bytecode of the package, and its kernels that are not on disk.
"""

from __future__ import annotations

import compileall
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "asbuilt"


def make_ready(place: int) -> None:
    """Compile the kernel at this place in the order of `import_kernels`."""
    from asbuilt.compilation import import_kernels

    import_kernels()[place].make_ready()


def main() -> None:
    """Compile."""
    compileall.compile_dir(PACKAGE, quiet=1, workers=0)
    from asbuilt.compilation import import_kernels

    missing = [k for k, each in enumerate(import_kernels()) if not each.is_on_disk()]
    if missing:
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(make_ready, missing))


if __name__ == "__main__":
    main()
