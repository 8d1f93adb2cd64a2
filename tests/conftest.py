"""numba keeps compiled kernels on disk and does not notice that a kernel which another file calls has changed."""

from pathlib import Path

import pumafuse

SOURCE = Path(pumafuse.__file__).parent


def pytest_configure() -> None:
    """Remove compiled kernels that are older than any of their sources."""
    kernels = (path for path in SOURCE.rglob("*.py") if "compiled import" in path.read_text(encoding="utf-8"))
    newest = max(path.stat().st_mtime for path in (SOURCE / "compiled.py", *kernels))
    for kept in SOURCE.rglob("*.nb[ic]"):
        if kept.stat().st_mtime < newest:
            kept.unlink(missing_ok=True)
