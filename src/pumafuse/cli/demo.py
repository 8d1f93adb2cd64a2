"""`pumafuse demo`."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.offline import fuse
from ..logs.run import Run
from .fuse import progress_of, show, write
from .tables import console

_SENSOR = "vision"  # alone: without the laser tracker it shows best what a camera and a model do together


def run(output: Path, force: bool) -> None:
    """Fuse the shipped scan, score it, draw it, and say what to open next.

    Raises:
        PumafuseError: The folder is in the way.
    """
    results.check_writable(output, force)
    out = console(soft_wrap=True)
    out.print(
        "A 60 s scan of a panel by a PUMA 560 (simulated with masses, friction, elastic joints and servos of which the"
        " filter knows\nnothing): a command every 28 ms, a camera (0.5 mm noise, 45 ms late, dropouts and outliers),"
        " and a reference to score\nagainst that the filter never sees.\n"
    )
    with as_file(files("pumafuse") / "data") as data:
        recorded, config = Run.read(data / "scan1"), FusionConfig.load(data / "fusion.toml")
        with progress_of(recorded.name) as progress:
            est = fuse(recorded, config, sensors=[_SENSOR], rate=200.0, progress=progress)
        summary = write(est, recorded, output, rrd=True, figures=True, force=force)
        show(summary, output)
        out.print(
            f"\nWhat to open next:\n"
            f"  {output / 'fused.png'}   the run: command, measurements, estimate with its band\n"
            f"  {output / 'error.png'}   its error against the reference, and the error bars\n"
            f"  {output / 'validation.png'}   is the filter as good as it says?\n"
            f"  rerun {output / 'fused.rrd'}   the same in the Rerun viewer\n"
            f"  {output / 'summary.json'}   every number of it\n"
            f"The same with the laser tracker as well:\n"
            f"  pumafuse fuse {data / 'scan1'} -c {data / 'fusion.toml'} --sensors tracker,vision --rate 200"
            f" -o with-tracker\n"
            f"  pumafuse compare {output} with-tracker"
        )
