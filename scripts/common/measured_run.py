"""Arguments of the scripts that measure one run of ``reconstruct``."""

from __future__ import annotations

import argparse
from pathlib import Path


def read_run_arguments(description: str | None) -> argparse.Namespace:
    """Read ``capture``, ``out``, ``json`` and ``options`` of reconstruct from the command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path, help="made anew")
    parser.add_argument("--json", type=Path)
    parser.add_argument("options", nargs="*", help="of reconstruct, after --")
    return parser.parse_args()
