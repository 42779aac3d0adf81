"""Write the examples in Python of the README and the docs as files, which a type checker can read.

    python scripts/doc_examples.py FOLDER

One file a page, for ``mypy colmap_inertial FOLDER`` (``scripts/test.sh`` does that) or pyright. Examples of a page
follow one another, so that a name may be bound again, and functions of a user's own need no annotations.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/python.md", "docs/imaging.md")
#: Paths as text, and plain numbers of a scale that was not refused.
MORE = """\
import colmap_inertial as ci
timing = ci.read_frame_times('frames.csv')
trajectory, _ = ci.trajectory_from_model(ci.read_model('sparse/0'), timing)
length_m: float = 2.0 * ci.estimate_scale(trajectory, ci.read_imu('imu.csv')).accepted.metres_per_unit
"""


def write_examples(folder: Path) -> list[Path]:
    """Write the files; returns their paths."""
    written = []
    for page in PAGES:
        blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.S)
        if page == PAGES[0]:
            blocks.append(MORE)
        path = folder / f"{Path(page).stem.lower()}_examples.py"
        path.write_text("\n\n".join(["# mypy: allow-untyped-defs, allow-redefinition", *blocks]))
        written.append(path)
    return written


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    write_examples(Path(sys.argv[1]))
